"""What density heads of several families share."""
