"""Data sets of registered bodies: scans of synthetic people, and FAUST."""
