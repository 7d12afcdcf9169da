"""Outlier exposure: high uncertainty on outliers (thesis §2.3.5)."""
