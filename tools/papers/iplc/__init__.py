"""Paper 5: predictive learning that trades error for energy."""
