"""Angular deviations: mean and median."""
