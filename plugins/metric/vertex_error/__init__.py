"""How far predicted vertices are from the true ones."""
