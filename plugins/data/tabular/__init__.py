"""Data set that reads a user's own CSV table."""
