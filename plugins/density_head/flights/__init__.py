"""Densities of where a ball will be: by its differential equation, and frame by frame by a recurrent network."""
