"""A density as named tensors, from which code without torch computes it; `mode=export` writes them."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import singledispatch
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal

from framework.distributions.affine import AffineDensity
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture
from framework.distributions.normals import IndependentNormals, JointNormal
from framework.distributions.uniform import UniformAngles
from framework.errors import ConfigError

NUMPY = "framework.distributions.numpy_densities"
"""Module with the NumPy code of the families that belong to no plugin."""


@dataclass(frozen=True)
class Exported:
    """A density as tensors.

    Attributes:
        family: name of the family, a key of `FAMILIES` in the module `code`.
        parameters: constructor arguments of the family that are tensors, by name; each has the shape (*batch, ...).
        parts: constructor arguments that are densities themselves, or lists of densities.
        settings: constructor arguments that are the same for every input, as plain values.
        code: import path of a module that computes the family with NumPy alone.
        remark: sentence for the user if the original density is only estimated, so that its log-densities differ from
            those of the exported density; "" otherwise.
    """

    family: str
    parameters: Mapping[str, Tensor] = field(default_factory=dict)
    parts: Mapping[str, "Exported | list[Exported]"] = field(default_factory=dict)
    settings: Mapping[str, Any] = field(default_factory=dict)
    code: str = NUMPY
    remark: str = ""

    def map_tensors(self, change: Callable[[Tensor], Tensor]) -> "Exported":
        """Return the same density with `change` applied to each tensor."""
        parts = {
            key: [one.map_tensors(change) for one in part]
            if isinstance(part, list)
            else part.map_tensors(change)
            for key, part in self.parts.items()
        }
        parameters = {key: change(value) for key, value in self.parameters.items()}
        return replace(self, parameters=parameters, parts=parts)

    def tensors(self, path: str = "") -> Iterator[tuple[str, Tensor]]:
        """Yield every tensor with its path, such as "components.location"."""
        for key, value in self.parameters.items():
            yield path + key, value
        for key, part in self._named_parts(path):
            yield from part.tensors(key)

    def layout(self, path: str = "") -> dict[str, Any]:
        """Return the density as plain values, with the paths of its tensors in place of the tensors."""
        parts: dict[str, Any] = {}
        for key, part in self.parts.items():
            parts[key] = (
                [one.layout(f"{path}{key}{number}.") for number, one in enumerate(part)]
                if isinstance(part, list)
                else part.layout(f"{path}{key}.")
            )
        parameters = {key: path + key for key in self.parameters}
        return {
            "family": self.family,
            "parameters": parameters,
            "parts": parts,
            "settings": dict(self.settings),
        }

    def modules(self) -> Iterator[str]:
        """Yield the import path of the NumPy code of each family."""
        yield self.code
        for _, part in self._named_parts(""):
            yield from part.modules()

    def remarks(self) -> Iterator[str]:
        """Yield the remarks of the density and of its parts."""
        if self.remark:
            yield self.remark
        for _, part in self._named_parts(""):
            yield from part.remarks()

    def _named_parts(self, path: str) -> Iterator[tuple[str, "Exported"]]:
        for key, part in self.parts.items():
            if isinstance(part, list):
                yield from ((f"{path}{key}{number}.", one) for number, one in enumerate(part))
            else:
                yield f"{path}{key}.", part


@singledispatch
def exported(density: Distribution) -> Exported:
    """Return a density as tensors, whose computation torch can trace.

    A density whose log_prob is a function of tensors registers its own function. This function also names a module of
    NumPy code if the family of the density is not in `numpy_densities`. By default, a density cannot be exported.

    Raises:
        ConfigError: the density has not registered a function, for example because it draws random numbers.
    """
    raise ConfigError(
        f"A {type(density).__name__} cannot be exported, because its values are not a function of a few tensors that "
        "NumPy could read: it draws random numbers, or no such function is registered with "
        "`framework.distributions.exported.exported.register`. Use framework.load or framework.freeze for this model."
    )


@exported.register
def _(density: Categorical) -> Exported:
    return Exported("categorical", {"logits": density.logits})


@exported.register
def _(density: IndependentNormals) -> Exported:
    return Exported("normal", {"location": density.mean, "scale": density.base_dist.scale})


@exported.register
def _(density: Independent) -> Exported:
    base = density.base_dist
    if type(base) is Normal and len(density.event_shape) == 1:
        return Exported("normal", {"location": base.loc, "scale": base.scale})
    return exported.dispatch(Distribution)(density)


@exported.register
def _(density: JointNormal) -> Exported:
    # R = A diag(σ) with a unit triangular A; the residuals are A⁻¹ d, so φ = I - A⁻¹
    scale = density.root.diagonal(dim1=-2, dim2=-1)
    identity = torch.eye(scale.shape[-1], dtype=scale.dtype, device=scale.device)
    mixing = density.root / scale.unsqueeze(-2)
    inverse = torch.linalg.solve_triangular(
        mixing, identity.expand_as(mixing), upper=False, unitriangular=True
    )
    return Exported("normal", {"location": density.loc, "scale": scale, "coefficients": identity - inverse})


@exported.register
def _(density: Mixture) -> Exported:
    if (
        type(density) is not Mixture
    ):  # a subclass changes what a mixture is, for example by drawing its components
        return exported.dispatch(Distribution)(density)
    return Exported(
        "mixture", {"log_weights": density.log_weights}, {"components": exported(density.components)}
    )


@exported.register
def _(density: Stacked) -> Exported:
    return Exported("stacked", {}, {"densities": [exported(each) for each in density.densities]})


@exported.register
def _(density: Reshaped) -> Exported:
    before = len(density.density.batch_shape)
    return exported(density.density).map_tensors(
        lambda tensor: tensor.reshape(*density.batch_shape, *tensor.shape[before:])
    )


@exported.register
def _(density: AffineDensity) -> Exported:
    parameters = {"location": density.location, "scale": density.scale}
    return Exported("affine", parameters, {"inner": exported(density.density)})


@exported.register
def _(density: UniformAngles) -> Exported:
    # the type alone of `like` counts: its numbers are an empty draw
    return Exported(
        "uniform",
        {"location": torch.zeros(density.batch_shape + density.event_shape, dtype=density.like.dtype)},
    )
