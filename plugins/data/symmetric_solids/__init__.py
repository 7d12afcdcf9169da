"""Generated images of symmetric solids in random rotations, with the known density of their labels."""
