"""Train dynamics, one model a file."""
