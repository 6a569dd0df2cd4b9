"""Paper 2: robust adaptive backstepping, a high-speed train."""
