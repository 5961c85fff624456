"""The actor: newest observation in, action out, before the deadline."""
