"""Base classes of the planted faults."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

from framework.target import Target


@dataclass(frozen=True)
class Planted:
    """A plugin with one planted fault.

    Attributes:
        name: description of the fault.
        by: name of the check that must find the fault.
    """

    name: str
    by: str


@dataclass(frozen=True)
class ChangedClass(Planted):
    """A plugin with one planted fault: a correct class with some methods and attributes replaced.

    Attributes:
        base: correct class.
        changes: methods and attributes of `base` that are replaced.
    """

    base: type
    changes: Mapping[str, Any] = field(default_factory=dict)

    @cached_property
    def kind(self) -> Any:
        """The faulty class, always the same one: neither encoders nor states of two classes can be combined."""
        return type(self.base.__name__, (self.base,), dict(self.changes))


@dataclass(frozen=True)
class PlantedForTarget:
    """A plugin for one target with one planted fault.

    Attributes:
        name: description of the fault.
        kind: class of the plugin, or a function that builds it.
        target: target that is predicted.
        by: name of a check that must find the fault.
    """

    name: str
    kind: Callable[..., Any]
    target: Target
    by: str
