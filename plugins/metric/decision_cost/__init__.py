"""Cost of actions that are chosen by the predicted densities."""
