"""Least-squares fits of each Z-spectrum that start from a trained model's prediction."""
