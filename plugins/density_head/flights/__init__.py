"""Densities of the future positions of a ball: by its differential equation, and by a recurrent network."""
