"""Code that several density heads share."""
