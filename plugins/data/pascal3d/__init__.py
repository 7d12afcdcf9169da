"""Data set PASCAL3D+ of viewpoints: reading of the official layout, and a generator that writes it."""
