"""Data set of labelled scans, in which every point has a class."""
