"""Selective prediction: risk against coverage."""
