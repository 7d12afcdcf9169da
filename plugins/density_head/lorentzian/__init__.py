"""Lorentzian lines fitted to each Z-spectrum."""
