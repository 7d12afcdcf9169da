"""Simplified conditional variational autoencoder (thesis §3.5.2)."""
