"""The simulated worlds: what a step of each does, and how it drifts."""
