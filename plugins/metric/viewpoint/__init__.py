"""Viewpoint accuracy and median error of the rotation of the object."""
