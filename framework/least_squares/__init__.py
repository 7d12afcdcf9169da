"""Bounded nonlinear least squares of many small problems at once."""
