"""`tenuto latency`: the real-time test of this machine."""
