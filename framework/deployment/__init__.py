"""Frozen models: one CPU core, no gradient, and no parts that only training needs."""
