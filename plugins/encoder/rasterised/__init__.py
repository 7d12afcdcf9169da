"""Rendered image of a registered mesh."""
