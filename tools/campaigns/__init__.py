"""Many runs for one question: sweeps, comparisons, threats, random frames, endurance."""
