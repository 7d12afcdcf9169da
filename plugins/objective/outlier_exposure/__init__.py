"""Outlier exposure: high uncertainty on inputs that are not data (thesis §2.3.5)."""
