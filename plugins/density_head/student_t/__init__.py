"""Student's t densities of real numbers, and their head."""
