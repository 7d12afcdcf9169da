"""Training steps, the order of batches, checkpoints, cached features, fitting without gradient."""
