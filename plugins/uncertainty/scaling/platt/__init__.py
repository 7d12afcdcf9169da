"""Slope and biases for the log-probabilities of classes."""
