"""Class probabilities as a density head."""
