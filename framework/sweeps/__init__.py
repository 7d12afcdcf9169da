"""Sweeps: running many jobs on one machine, and comparing them."""
