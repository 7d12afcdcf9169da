"""The base class of densities, and a density as one line of text: its kind, shapes and distribution parameters."""

from typing import ClassVar

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints

LONGEST = 200
"""Largest number of characters of the line that describes a density."""
WHOLE = 6
"""Largest number of elements of a parameter that is printed in full; for a longer parameter, the range is printed."""


def one_line(self: Distribution) -> str:
    """Return a density as one line: its class, its shapes, the names of its target (if it has them) and its parameters.

    The function draws and integrates nothing. Densities use it as their `__repr__`.
    """
    batch, event = (tuple(shape) for shape in (self.batch_shape, self.event_shape))
    parts = [f"batch={batch}", f"event={event}"]
    names = getattr(self, "names", ())
    if names:
        parts.append(f"names={', '.join(map(str, names[:WHOLE]))}{', …' * (len(names) > WHOLE)}")
    parts += _parameters(self)
    line = f"{type(self).__name__}({', '.join(parts)})"
    return line if len(line) <= LONGEST else f"{line[: LONGEST - 2]}…)"


class PlainDensity(Distribution):
    """Base class of densities whose parameters torch does not check, and which are printed as one line (`one_line`)."""

    arg_constraints: ClassVar[dict[str, constraints.Constraint]] = {}
    has_rsample = False
    __repr__ = one_line


class DerivedDensity(PlainDensity):
    """Base class of densities that are computed from another density and have its support.

    Args:
        density: the other density.
        batch_shape: batch_shape of the result; None for that of `density`.
    """

    def __init__(self, density: Distribution, batch_shape: torch.Size | None = None) -> None:
        self.density = density
        shape = density.batch_shape if batch_shape is None else batch_shape
        super().__init__(shape, density.event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint | None:
        """Support of the density."""
        return self.density.support


class CategoricalDensity(Categorical):
    """torch's categorical density, printed as one line (`one_line`) like the project's own densities."""

    __repr__ = one_line


def _parameters(density: Distribution, inner: bool = True) -> list[str]:
    """Return the parameters of a density as texts `name=value`.

    Args:
        density: the density.
        inner: if true, a density among the attributes is printed with its parameters; otherwise only its class is
            printed.
    """
    texts = ((key, _parameter(key, value, inner)) for key, value in vars(density).items())
    return [f"{key}={text}" for key, text in texts if text]


def _parameter(key: str, value: object, inner: bool) -> str:
    """Return an attribute of a density as a short text; '' if it is not printed because it is not a parameter.

    Args:
        key: name of the attribute.
        value: its value.
        inner: as in `_parameters`.
    """
    if key.startswith("_"):
        return ""
    if isinstance(value, Distribution):
        own = _parameters(value, inner=False) if inner else []
        return f"{type(value).__name__}({', '.join(own)})" if own else type(value).__name__
    if isinstance(value, float):
        return f"{value:.4g}"
    if not isinstance(value, Tensor) or not value.numel():
        return ""
    numbers = value.detach()
    if numbers.numel() <= WHOLE:
        return f"[{', '.join(f'{number:.4g}' for number in numbers.flatten().tolist())}]"
    if numbers.dtype == torch.bool or numbers.is_complex():
        return ""
    least, most = (float(number) for number in (numbers.min(), numbers.max()))
    return f"{least:.4g}…{most:.4g}"
