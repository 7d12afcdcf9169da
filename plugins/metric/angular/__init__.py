"""Mean and median angular deviation of the point prediction."""
