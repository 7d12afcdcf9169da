"""Latent-variable densities: CVAE and simplified CVAE."""
