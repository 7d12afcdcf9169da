"""Registered bodies: scans of synthetic people, and FAUST."""
