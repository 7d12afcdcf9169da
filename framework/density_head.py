"""The contract of a density head: raw numbers in, a probability density over the target out."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution


class DensityHead(nn.Module, ABC):
    """Turns raw network outputs into a density over the target.

    The framework puts one linear layer, encoder features → `size` raw numbers, in front of every head (the final
    layer "set to match the number of required parameters", thesis §3.6.1). So a head owns the meaning of the raw
    numbers and nothing before them, and any head can be a component of another: a mixture of K components reads
    K × (component.size + 1) numbers. A head that is `direct` reads the features themselves.

    A constructor asks for `target: Target` (framework.target) before `*`; its keyword-only parameters are the
    config. It calls `target.require("angle", by="...")` or the like, so that it refuses what it cannot describe.

    The density is a `torch.distributions.Distribution` (build it with `validate_args=False`; the head has checked)
    with `batch_shape == raw.shape[:-1]`; its `event_shape` is `target.event_shape`: `(len(target.names),)` for angles
    and reals, `()` for classes, `(height, width, len(target.names))` for images. It has `log_prob` (nats), `sample`,
    `entropy` (nats) and `mode`. Angles are radians and read modulo 2π; the `support` of their density is
    `distributions.circular.circular`. What else a density may be asked stands on one page,
    framework.distributions.protocol: over several numbers it registers `marginal`, over an image `images`, and where
    its log_prob draws nothing `estimate` with `exactly`; the rest has defaults that claim nothing they do not know.

    Raw numbers may be anything finite, however large; the head maps them to a density whose log_prob is finite
    wherever the true one is, in float32 and float64; half precision is upcast to float32. Non-finite raw numbers
    are refused with a `ValueError` that names the first bad batch row. A batch may be of any shape, also empty.
    """

    group: ClassVar[str] = "density_head"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    """Attributes that trade error for run time and may be set at any time after training, with the values worth
    trying, ascending: {"samples": (1, 3, 10, 30)}. Empty where there is none."""
    direct: ClassVar[bool] = False
    """Whether the last encoder's features, flattened, are the raw numbers, without a linear layer: images, say, whose
    every pixel an encoder gives. There must be `size` of them."""
    size: int
    """How many raw numbers the head reads per sample, > 0; set by the constructor."""
    backbones: tuple[int, ...] = ()
    """Sizes of parts of the raw numbers, in order and `size` together, each of which encoders of its own give: as many
    networks as there are parts. Empty: one gives all. May be set by the constructor."""

    @abstractmethod
    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """The density over the target, given raw numbers. Called for training, testing and prediction.

        In training mode the density may be a cheaper one than in evaluation (fewer samples). Random numbers come
        from torch's global generator, which the framework seeds before every step.
        """

    @abstractmethod
    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """The training loss per sample in nats, differentiable in `raw`; the framework takes the mean.

        Usually `-self(raw).log_prob(target)`; a variational head returns its negative bound.
        """

    @abstractmethod
    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit what is not trained by gradient, such as a single global concentration (eq. 3.5), in place.

        Called once after training, in evaluation mode and without gradient, with the whole validation set. What it
        fits is a buffer, so that it is stored in the checkpoint. A head with nothing to fit does nothing.
        """


class Fitted(ABC):
    """A density head that is fitted to the whole training split at once and not by gradient: trees, say.

    No linear layer is put before it: it reads the features as they are, and its `size` is their number, 0 before it
    was fitted. Encoders before it may not learn either. Its state is of any shape: `load_state_dict` takes what is
    stored, in a head that was just built.
    """

    @abstractmethod
    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        """Fit to all training samples, in place.

        Args:
            features: of the training split.
            target: theirs, (sample, *event).
            seed: of what is drawn; members of an ensemble get different ones.
        """
