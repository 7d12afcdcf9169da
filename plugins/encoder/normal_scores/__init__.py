"""Encoder that appends the normal scores of numbers to the numbers."""
