"""Brier score of class probabilities."""
