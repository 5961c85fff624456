"""Students with neural networks: soft actor-critic and what builds on it."""
