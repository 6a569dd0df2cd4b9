"""What is seen of a run: the Rerun trace, its blueprints and charts, and the viewer."""
