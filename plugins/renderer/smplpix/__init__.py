"""People rendered by neural pixels: what a body's points show, and the networks that paint a picture of it."""
