"""One temperature for all densities."""
