"""Students with tables: finite states and actions."""
