"""Adversarial training by the fast gradient sign method (thesis §2.3.5)."""
