"""Monte Carlo dropout: dropout stays active in evaluation, and the density is a mixture over dropout masks."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Annotated, Any, NamedTuple

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.calibration.equal_mixture import equal_mixture
from framework.calibration.module_flags import set_flag
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.given_draws import draws_are_given
from framework.errors import ConfigError, UserError
from framework.model import Model, Predictor
from framework.storage.limits import MOST_DRAWS
from framework.uncertainty import Uncertainty

DROPOUT = (nn.Dropout, nn.Dropout1d, nn.Dropout2d, nn.Dropout3d, nn.AlphaDropout, nn.FeatureAlphaDropout)
AT_ONCE = 2**24
"""Largest number of values that enter a dropout layer at once (64 MiB in float32).

If all samples together need more, they are computed in parts.
"""


class Layout(NamedTuple):
    """Method by which the outputs of a network under several dropout masks are computed.

    Attributes:
        vectorised: True if `torch.vmap` runs the network; layers before the first dropout layer are then computed only
            once for all masks. False if the network is run on one copy of each input for each mask.
        widest: largest number of values that enter a dropout layer or, without vmap, the network, for one input and one
            mask. The memory that a pass needs grows with this number.
    """

    vectorised: bool
    widest: int


class MCDropout(Uncertainty):
    """Mixture, with equal weights, of the densities under S dropout masks (thesis eq. 2.16; Gal & Ghahramani 2016).

    In training, and for the validation loss, the wrapper equals the wrapped model. In evaluation only its dropout
    layers (`DROPOUT`) stay in training mode; batch norm normalises as in any evaluation. Every input of a batch has its
    own S masks, sampled from torch's global generator. The wrapped model is calibrated without dropout.

    Layers before the first dropout are computed once and not S times, if the network can be vectorised.

    Args:
        model: function that builds the wrapped model, which needs a dropout layer with a probability above 0.
        samples: S, which may be changed after training (a knob); 1 gives the density of one stochastic pass.

    Raises:
        ConfigError: the model has no such dropout layer, or `samples` was set below 1.
        UserError: the network's output is not finite under some mask; the message names the mask and the input.
    """

    knobs = {"samples": (1, 3, 10, 30, 100)}  # noqa: RUF012 - never written
    bibtex = "gal2016dropout"

    def __init__(
        self, model: Callable[[], Predictor], *, samples: Annotated[int, Field(ge=1, le=MOST_DRAWS)] = 50
    ) -> None:
        super().__init__()
        self.model = model()
        self.samples = samples
        self.layout: Layout | None = None  # determined at the first prediction
        if not any(layer.p > 0 for layer in _dropouts(self.model)):
            raise ConfigError(
                "uncertainty mc_dropout needs a dropout layer with a probability above 0, but the model has none, so "
                "that every sample would be the same. Give the encoder dropout, e.g. encoder.mlp.dropout=0.2."
            )

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the density in training, and the mixture over dropout masks in evaluation."""
        if self.training:
            return self.model(inputs)
        if self.samples < 1:
            raise ConfigError(f"uncertainty.mc_dropout.samples is {self.samples}, expected 1 or more.")
        with set_flag(self.model, DROPOUT, "training", True):
            components = self._components(inputs)
        return equal_mixture(components, self.model, inputs.device)

    def _components(self, inputs: Tensor) -> Distribution:
        """Return the densities of every input under its S masks, batch_shape (batch, S)."""
        whole = (inputs.shape[0], self.samples)
        if draws_are_given():  # as an exported model draws them: for the copies of all inputs together
            copies = inputs if self.samples == 1 else inputs.repeat_interleave(self.samples, 0)
            if isinstance(self.model, Model):
                return self.model.head(self.model.raw(copies).unflatten(0, (-1, self.samples)))
            return Reshaped(self.model(copies), whole)
        if self.samples == 1 or len(inputs) == 0:
            density = self.model(inputs)
            return Reshaped(density, whole) if self.samples == 1 else Stacked([density] * self.samples)
        if isinstance(self.model, Model):
            return self.model.head(require_finite(self._raws(self.model, inputs)))
        if inputs.numel() * self.samples <= AT_ONCE:
            return Reshaped(self.model(inputs.repeat_interleave(self.samples, 0)), whole)
        return Stacked([self.model(inputs) for _ in range(self.samples)])

    def _raws(self, model: Model, inputs: Tensor) -> Float[Tensor, "batch sample *raw"]:
        """Return the head's raw parameters for every input under each of its S dropout masks."""
        if not any(
            layer.p > 0 for layer in _dropouts(model)
        ):  # set to 0 after the model was built: equal masks
            return torch.stack([model.raw(inputs)] * self.samples, 1)
        self.layout = self.layout or layout_of(model, inputs)
        at_once = max(1, AT_ONCE // (len(inputs) * self.layout.widest))
        counts = [min(at_once, self.samples - start) for start in range(0, self.samples, at_once)]
        compute = _vectorised if self.layout.vectorised else _repeated
        return torch.cat([compute(model, inputs, count) for count in counts], 1)


def require_finite(raw: Float[Tensor, "batch sample *raw"]) -> Float[Tensor, "batch sample *raw"]:
    """Return `raw` unchanged.

    Raises:
        UserError: a number is not finite; the message names the mask and the input.
    """
    bad = (~raw.isfinite()).flatten(2).any(-1).nonzero()
    if len(bad):
        row, sample = bad[0].tolist()
        raise UserError(
            f"uncertainty mc_dropout: the output of the network is not finite under {len(bad)} dropout masks; "
            f"the first is mask {sample} of the input in batch row {row}. Check this input, or train with a lower "
            "optimizer.learning_rate."
        )
    return raw


def _dropouts(model: nn.Module) -> Iterator[Any]:
    return (module for module in model.modules() if isinstance(module, DROPOUT))


def _vectorised(model: Model, inputs: Tensor, count: int) -> Float[Tensor, "batch sample *raw"]:
    """Return the raw parameters of `count` passes with different dropout masks, by `torch.vmap`.

    Layers before the first dropout layer are computed only once.
    """
    sampled = torch.vmap(lambda _: model.raw(inputs), randomness="different", out_dims=1)
    return sampled(torch.empty(count, device=inputs.device))


def _repeated(model: Model, inputs: Tensor, count: int) -> Float[Tensor, "batch sample *raw"]:
    """Return the raw parameters under `count` dropout masks, by one pass over `count` copies of every input."""
    return model.raw(inputs.repeat_interleave(count, 0)).unflatten(0, (len(inputs), count))


def layout_of(model: Model, inputs: Tensor) -> Layout:
    """Return the method by which a model with active dropout layers is computed under several masks.

    `torch.vmap` is tried on one input and two masks. If it cannot run the network, or warns that it is slow, the method
    is to run the network on copies of the inputs. The global random generators keep their state.
    """
    devices = [inputs.device] if inputs.device.type == "cuda" else []
    with torch.random.fork_rng(devices), torch.no_grad(), warnings.catch_warnings(), _widths(model) as widths:
        warnings.simplefilter("error")
        try:
            _vectorised(model, inputs[:1], 2)
        except (RuntimeError, Warning):
            warnings.simplefilter("default")
            model.raw(inputs[:1])
            return Layout(False, max(1, inputs[0].numel(), *widths))
        return Layout(True, max(1, *widths))


@contextmanager
def _widths(model: Model) -> Iterator[list[int]]:
    """Yield a list to which, inside the block, each dropout layer appends the number of values that enter it."""
    widths: list[int] = [0]
    hooks = [
        layer.register_forward_pre_hook(lambda _, arguments: widths.append(arguments[0].numel()))
        for layer in _dropouts(model)
    ]
    try:
        yield widths
    finally:
        for hook in hooks:
            hook.remove()
