"""Frozen models: one CPU core, no gradient, nothing that only training needs."""
