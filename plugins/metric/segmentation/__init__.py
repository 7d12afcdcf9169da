"""Accuracy and intersection over union of points in scans, with standard errors over scans."""
