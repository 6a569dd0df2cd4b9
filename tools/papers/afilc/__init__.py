"""Paper 4: fuzzy iterative learning with varying run lengths."""

LAWS = ("afilc", "afilc-track", "p-ilc")  # of the paper, and its baselines
