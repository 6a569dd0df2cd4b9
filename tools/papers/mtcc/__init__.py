"""Paper 3: cooperative control of five trains with position barriers."""

LAWS = ("mtcc", "mtcc-single", "mtcc-pid")  # of the paper, and its baselines
