"""Mean log-likelihood of the targets, and its negative."""
