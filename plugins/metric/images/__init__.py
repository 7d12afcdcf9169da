"""How much predicted images look like the true ones: colours, silhouettes and depths."""
