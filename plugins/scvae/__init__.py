"""Simplified conditional variational autoencoder: an infinite mixture with a standard normal prior (thesis §3.5.2)."""
