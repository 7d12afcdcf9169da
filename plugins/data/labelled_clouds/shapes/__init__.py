"""Generated CAD models: random furniture, vessels and machine parts as closed solids."""
