"""Paper 5: predictive learning that trades error for energy."""

LAWS = ("iplc", "norm-optimal")  # of the paper, and its baselines
