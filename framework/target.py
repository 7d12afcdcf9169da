"""The predicted quantity: the kind of value, and the name of each number in it."""

from dataclasses import dataclass
from typing import Literal

from framework.errors import ConfigError

Kind = Literal["angle", "real", "class", "image"]
"""Kinds of targets; `Target` describes them."""
MOST = 40
"""Largest number of names that a message lists in full."""


@dataclass(frozen=True)
class Target:
    """The quantity that a density head predicts.

    Attributes:
        kind: "angle": radians, read modulo 2π; "real": any real number; "class": one of several labels; "image": images
            with values as in files (sRGB), 0…1.
        names: for angles and reals the name of each number, e.g. ("azimuth", "elevation", "tilt"); a batch of targets
            is a float tensor of shape (batch, len(names)). For classes the label names; a batch of targets is an int64
            tensor of shape (batch,). For images the channels, ("red", "green", "blue"); a batch of targets is a float
            tensor of shape (batch, height, width, len(names)).
        location: for reals, the mean of each number over the training split. A head computes with numbers that are
            standardised by `location` and `scale`, so that its raw parameters are of the order of 1 in any unit of the
            target. () if the numbers are of that order already; they are then not standardised.
        scale: for reals, the standard deviation of each number over the training split; () as for `location`.
        size: for images, (height, width) in pixels; () for every other kind.
    """

    kind: Kind
    names: tuple[str, ...]
    location: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()
    size: tuple[int, ...] = ()

    @property
    def event_shape(self) -> tuple[int, ...]:
        """Shape of one target, and so of one sample of its density."""
        return () if self.kind == "class" else (*self.size, len(self.names))

    @property
    def listed_names(self) -> str:
        """Names of the target for a message; of very many names, the first ones and the number of the others."""
        first = self.names if len(self.names) <= MOST else self.names[: MOST // 4]
        rest = f" and {len(self.names) - len(first)} more" if len(first) < len(self.names) else ""
        return ", ".join(first) + rest

    def refuse(self, kind: Kind, message: str) -> None:
        """Refuse a target of this kind with a message.

        Raises:
            ConfigError: the target is of this kind.
        """
        if self.kind == kind:
            raise ConfigError(message)

    def require(self, kind: Kind, by: str) -> None:
        """Refuse a target of another kind than `kind`, which is the only kind that the plugin `by` can describe.

        Raises:
            ConfigError: the kinds differ.
        """
        if self.kind != kind:
            raise ConfigError(
                f"{by} describes targets of kind {kind!r}, but the targets of this data set are of kind "
                f"{self.kind!r} ({self.listed_names}). Choose another plugin for this target, or other data."
            )
