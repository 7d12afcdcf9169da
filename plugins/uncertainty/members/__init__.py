"""Mixtures over the members of an ensemble, or over the dropout masks of one network."""
