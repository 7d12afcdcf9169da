"""The von Mises density of angles, its mathematics and its head (thesis §3.4)."""
