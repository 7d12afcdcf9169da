"""Conditional variational autoencoder: an infinite mixture with a learned prior (thesis §3.5.2)."""
