"""Paper 1: adaptive iterative learning under a speed limit, a multi-car subway train."""

LAWS = ("cailc", "ailc", "pdilc", "adaptive", "pid")  # of the paper, and its baselines
