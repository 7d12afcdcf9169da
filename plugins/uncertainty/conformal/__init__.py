"""Sets that cover as promised."""
