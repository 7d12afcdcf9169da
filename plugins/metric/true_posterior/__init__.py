"""Comparison of the predicted azimuth density with the known symmetry of the object."""
