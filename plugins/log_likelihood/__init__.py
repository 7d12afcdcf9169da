"""Mean log-likelihood of the targets."""
