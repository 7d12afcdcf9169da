"""Distillation: one network learns the predicted densities of a trained ensemble (thesis §2.3.3)."""
