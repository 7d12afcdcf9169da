"""Generator of CAD models: random furniture, vessels, parts of buildings and other things as closed solids."""
