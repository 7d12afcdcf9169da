"""Objectives for predicted images: squared error, distance of network features, and discriminators."""
