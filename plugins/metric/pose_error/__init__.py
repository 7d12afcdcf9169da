"""Errors of a body's rotation and translation."""
