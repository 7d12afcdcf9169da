"""A uniform floor under another head's density."""
