"""The projected normal density of angles: the direction of a normal vector in the plane."""
