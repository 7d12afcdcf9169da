"""How far predicted flights are from where the ball went, and where they land."""
