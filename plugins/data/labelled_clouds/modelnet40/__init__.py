"""ModelNet40: CAD models of 40 classes as point clouds, and a generated set in its layout."""
