"""The rotation Laplace density of rotations, which has heavier tails than matrix Fisher (Yin et al. 2023)."""
