"""Calibration of highest-density regions."""
