"""A bare pacer-and-echo pair: what the machine does without Tenuto."""
