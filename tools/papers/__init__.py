"""Each paper's claims, figures and float64 reference, side by side in a folder of its own."""
