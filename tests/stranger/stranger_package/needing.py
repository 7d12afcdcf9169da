"""Metric that needs a module which may not be installed."""

import only_where_it_was_trained  # noqa: F401

from stranger_package.trial import MeanEntropy


class Needing(MeanEntropy):
    """Mean entropy."""
