"""Entropy on outliers, and separation of outliers from the test split."""
