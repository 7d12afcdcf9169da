"""Mean absolute angular deviation of the point prediction."""
