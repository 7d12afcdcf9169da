"""Viewpoint accuracy and median error on the rotation of the object."""
