"""Densities over images whose numbers are 0 or 1, with the probability of each number to be 1."""
