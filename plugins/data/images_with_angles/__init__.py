"""Data set of a folder of images with a table of angles."""
