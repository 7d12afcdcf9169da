"""PASCAL3D+ viewpoints: the official layout, and a generator that writes it."""
