"""A metric that needs a module which is not everywhere."""

import only_where_it_was_trained  # noqa: F401

from stranger_package.trial import MeanEntropy


class Needing(MeanEntropy):
    """Mean entropy."""
