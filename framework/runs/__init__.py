"""Runs: their folder, session and provenance, and the files that they read."""
