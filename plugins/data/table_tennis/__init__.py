"""Flights of a table-tennis ball: their physics, their recordings, and heads that know the physics."""
