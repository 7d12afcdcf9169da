"""Densities that belong to no single method, and the functions that are defined for every density (`protocol`)."""

# These imports register the functions of torch's densities and all defaults, whichever file is imported first.
from framework.distributions import closed_forms as closed_forms
from framework.distributions import tempering as tempering
