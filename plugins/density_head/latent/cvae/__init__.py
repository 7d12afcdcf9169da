"""Conditional variational autoencoder (thesis §3.5.2)."""
