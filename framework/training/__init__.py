"""Training steps, the order of batches, checkpoints, cached features, and fitting without gradient."""
