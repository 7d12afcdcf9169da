"""IDIAP head pose: pan, tilt and roll of heads in a meeting room: the published layout, a generator that writes it."""
