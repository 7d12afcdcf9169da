"""Finite mixture of any density head (thesis §3.5.1)."""
