"""Data set of images of a body, whose pose and shape are the target."""
