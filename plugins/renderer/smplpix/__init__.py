"""Renderer that draws people with a trained network from the points of a body (SMPLpix)."""
