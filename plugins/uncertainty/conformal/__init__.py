"""Conformal prediction sets with a stated coverage."""
