"""What a run is and what it leaves: frames, metrics, the row of a summary, files and recordings."""
