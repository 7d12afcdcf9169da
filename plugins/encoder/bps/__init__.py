"""Basis point sets as an encoder of point clouds."""
