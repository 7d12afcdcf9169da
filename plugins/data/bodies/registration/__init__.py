"""Registering a body's mesh to a scan: synthetic bodies, scanned."""
