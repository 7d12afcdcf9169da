"""Code that several uncertainty wrappers and objectives share."""
