"""A user's own CSV table as a data set."""
