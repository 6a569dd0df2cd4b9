"""Paper 4: fuzzy iterative learning with varying run lengths."""
