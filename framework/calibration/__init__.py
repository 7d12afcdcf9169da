"""Code that uncertainty wrappers and objectives of several families share."""
