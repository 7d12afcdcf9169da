"""Flights of a ball: observed frames, physics, simulation of many trajectories at once, and estimation of states."""
