"""What is to be predicted: the kind of value, and the name of each number in it."""

from dataclasses import dataclass
from typing import Literal

from framework.errors import ConfigError

Kind = Literal["angle", "real", "class", "image"]
MOST = 40
"""Names that a sentence lists in full."""


@dataclass(frozen=True)
class Target:
    """The quantity a density head predicts.

    Attributes:
        kind: "angle": radians, read modulo 2π; "real": any real number; "class": one of several labels;
            "image": pixels.
        names: for angles and reals the name of each number, e.g. ("azimuth", "elevation", "tilt"), and a batch
            of targets is a float tensor of shape (batch, len(names)); for classes the label names, and a batch
            of targets is an int64 tensor of shape (batch,); for images the name of each channel, and a batch of
            targets is a float tensor of shape (batch, *size, len(names)).
        location, scale: of reals, the mean and standard deviation of each number over the training split: a head
            is scaled by them, so that its raw numbers are of the order of 1 in whatever unit. () where the numbers
            are of that order already; the head then takes 0 and 1.
        size: of images (height, width), pixels; else ().
    """

    kind: Kind
    names: tuple[str, ...]
    location: tuple[float, ...] = ()
    scale: tuple[float, ...] = ()
    size: tuple[int, int] | tuple[()] = ()

    @property
    def told(self) -> str:
        """The names, for a sentence; of very many the first ones, and how many there are beside them."""
        first = self.names if len(self.names) <= MOST else self.names[: MOST // 4]
        rest = f" and {len(self.names) - len(first)} more" if len(first) < len(self.names) else ""
        return ", ".join(first) + rest

    def require(self, kind: Kind, by: str) -> None:
        """Refuse a target that `by` cannot describe.

        Raises:
            ConfigError: the kinds differ.
        """
        if self.kind != kind:
            raise ConfigError(
                f"{by} describes targets of kind {kind!r}, but this data set's are {self.kind!r} "
                f"({self.told}). Choose another one, or other data."
            )
