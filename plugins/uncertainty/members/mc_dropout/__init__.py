"""Monte Carlo dropout (thesis §2.3.2)."""
