"""Base of the planted faults."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Planted:
    """A plugin with one planted fault.

    Attributes:
        name: description of the fault.
        by: name of the check that must find the fault.
    """

    name: str
    by: str
