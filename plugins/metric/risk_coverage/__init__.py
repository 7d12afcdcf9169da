"""Selective prediction: error against the share of predictions that are kept."""
