"""Data set of flights of a table-tennis ball, recorded and simulated."""
