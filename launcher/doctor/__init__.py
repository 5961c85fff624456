"""`tenuto doctor`: what this machine lacks for real time."""
