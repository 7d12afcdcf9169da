"""Code that density heads of several families share."""
