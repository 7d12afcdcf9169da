"""Least squares of each Z-spectrum that start from a trained model's answer."""
