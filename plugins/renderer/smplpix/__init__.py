"""People rendered by neural pixels: a trained network paints the picture of a body's points."""
