"""What heads that are fitted at once share (framework.density_head.Fitted): state of any shape, and refusals."""

from abc import abstractmethod
from collections.abc import Mapping
from typing import Any

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, nn
from torch.distributions import Distribution, Independent, Normal

from framework.density import median
from framework.density_head import DensityHead, Fitted
from framework.errors import ConfigError, UserError
from framework.raw_numbers import require_finite
from framework.target import Target

FLOOR = 1e-4
"""The least standard deviation of a density over reals, which should be of the order of 1."""


class IndependentNormals(Independent):
    """Normal densities of several reals, independent of one another; unlike torch's own also of an empty batch.

    Args:
        mean, scale: (*batch, number).
    """

    def __init__(self, mean: Tensor, scale: Tensor) -> None:
        super().__init__(Normal(mean, scale, validate_args=False), 1, validate_args=False)

    def log_prob(self, value: Tensor) -> Tensor:
        return self.base_dist.log_prob(value).sum(-1)

    def entropy(self) -> Tensor:
        return self.base_dist.entropy().sum(-1)


@median.register
def _(density: IndependentNormals, samples: int) -> Tensor:
    # each is symmetric about its mean
    return density.mean


class FittedHead(DensityHead, Fitted):
    """A head of classes or reals that holds what was fitted in buffers of any shape, with one width for each real.

    A subclass's `fit` sets its buffers and calls `was_fitted`; it writes `predicted` and, for reals, `likeliest_width`.

    Attributes:
        classes: how many; 0 where the target is real.
        numbers: of a real target; 0 where it is a class.
        width: (numbers,) float64, standard deviations.
        size: how many features were fitted; 0 before.

    Args:
        by: who refuses, in errors.

    Raises:
        ConfigError: the target is an angle.
        UserError: it is used before it was fitted.
    """

    width: Tensor
    read: Tensor

    def __init__(self, target: Target, by: str) -> None:
        super().__init__()
        if target.kind == "angle":
            raise ConfigError(
                f"{by} describes targets of kind 'class' or 'real', but this data set's are 'angle' "
                f"({target.told}). Choose another density_head, or other data."
            )
        self.by = by
        self.classes = len(target.names) if target.kind == "class" else 0
        self.numbers = 0 if self.classes else len(target.names)
        self.register_buffer("width", torch.ones(self.numbers, dtype=torch.float64))
        self.register_buffer("read", torch.zeros((), dtype=torch.int64))
        self.size = 0

    def was_fitted(self, features: int) -> None:
        """To be called when all buffers are set."""
        self.read.fill_(features)
        self.size = features

    @abstractmethod
    def predicted(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """The density of finite features, after the fit."""

    @abstractmethod
    def likeliest_width(
        self, raw: Float[Tensor, "batch size"], target: Float[Tensor, "batch number"]
    ) -> Float[Tensor, "number"]:
        """The widths of greatest likelihood on samples that were not fitted."""

    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        if self.size == 0:
            raise UserError(
                f"{self.by} was not fitted: train it with `python -m framework ...`, or load a trained run with "
                "framework.load."
            )
        return self.predicted(require_finite(raw, self.size))

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        return -self(raw).log_prob(target)

    @torch.no_grad()
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        if self.classes:
            return
        if len(raw) == 0:
            raise ValueError(
                f"the widths of {self.by} are calibrated on validation data, but got none of it."
            )
        self.width.copy_(self.likeliest_width(raw, target.double()).clamp(min=FLOOR))

    def _load_from_state_dict(self, state_dict: Any, prefix: str, *rest: Any) -> None:
        take_shapes(self, state_dict, prefix)
        super()._load_from_state_dict(state_dict, prefix, *rest)
        self.was_fitted(int(self.read))


def single(features: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Features on the CPU in float32, in which trees compare; what exceeds it is cut off."""
    most = torch.finfo(torch.float32).max
    return features.detach().clamp(-most, most).to("cpu", torch.float32).contiguous()


def take_shapes(module: nn.Module, state: Mapping[str, Shaped[Tensor, "..."]], prefix: str) -> None:
    """Give a module's own buffers the shapes they have in a state, keeping type and device.

    To be called first in its `_load_from_state_dict(state, prefix, ...)`; torch copies the numbers afterwards.
    """
    for name, buffer in module.named_buffers(recurse=False):
        if prefix + name in state:
            shape = state[prefix + name].shape
            setattr(module, name, torch.empty(shape, dtype=buffer.dtype, device=buffer.device))
