"""What it costs to act on the predicted densities."""
