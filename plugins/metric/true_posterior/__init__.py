"""The predicted azimuth density against the known symmetry of the object."""
