"""Log-likelihood of rotations of symmetric objects beside its optimum, and the spread around equivalent rotations."""
