"""Flights of a table-tennis ball: recorded and simulated."""
