"""A folder of images and a table of angles as a data set."""
