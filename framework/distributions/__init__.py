"""Densities that belong to no single method, and the questions that every density can be asked (`protocol`)."""

# These imports register the answers of torch's densities and all defaults, whichever file is imported first.
from framework.distributions import closed_forms as closed_forms
from framework.distributions import tempering as tempering
