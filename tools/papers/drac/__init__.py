"""Paper 2: robust adaptive backstepping, a high-speed train."""

LAWS = ("drac", "drac-robust", "drac-exact", "pid-feedforward")  # of the paper, and its baselines
