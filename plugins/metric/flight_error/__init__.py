"""Distance of predicted flights from the true ones, and accuracy of predicted landing places."""
