"""Calibration of the uncertainty that is predicted for each pixel of an image."""
