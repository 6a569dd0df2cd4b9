"""Paper 1: adaptive iterative learning under a speed limit, a multi-car subway train."""
