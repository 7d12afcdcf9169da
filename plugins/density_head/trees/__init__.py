"""Trees as density heads: extremely randomised and gradient boosted."""
