"""Flights of a ball: the frames in which it is seen, its physics, many trajectories at once, states from frames."""
