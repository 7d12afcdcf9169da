"""CAVIAR-o: gaze of partly hidden pedestrians; the published layout, and a generator that writes it."""
