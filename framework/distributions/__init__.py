"""Densities that no method owns, and everything that a density may be asked (`protocol`)."""

# What torch's densities answer, and every default, is registered whichever file is imported first.
from framework.distributions import closed_forms as closed_forms
from framework.distributions import tempering as tempering
