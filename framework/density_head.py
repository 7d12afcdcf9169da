"""The contract of a density head: it turns raw parameters into a probability density over the target."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.distributions import Distribution


class DensityHead(nn.Module, ABC):
    """Base class of the modules that turn raw parameters, the outputs of a network, into a density over the target.

    The framework puts one linear layer, encoder features → `size` raw parameters, in front of every head (the final
    layer "set to match the number of required parameters", thesis §3.6.1). So a head defines the meaning of the raw
    parameters and nothing before them, and any head can be a component of another: a mixture of K components reads K ×
    (component.size + 1) raw parameters. A head that is `direct` reads the features themselves, as a vector or in the
    shape that it says (`raw_shape`).

    A constructor takes `target: Target` (framework.target) before `*`; its keyword-only parameters are the config. It
    calls `target.require("angle", by="...")` or the like to refuse targets that it cannot describe.

    The density is a `torch.distributions.Distribution` (build it with `validate_args=False`, since the head checks
    `raw`). Its `batch_shape` is the shape of `raw` without the last dimensions, which are `raw_shape`. Its
    `event_shape` is `target.event_shape`: `(len(target.names),)` for angles and reals, `()` for classes, `(height,
    width, len(target.names))` for images. It has `log_prob` (nats), `sample`, `entropy` (nats) and `mode`. Angles are
    radians and read modulo 2π; the `support` of their density is `distributions.circular.circular`.
    framework.distributions.protocol describes all other functions of a density. A density over several numbers
    registers `marginal`. A density over an image registers `images`. A density whose log_prob draws nothing registers
    `exact_estimate` as its `estimate`. The other functions have defaults, none of which claims to be exact.

    Raw parameters may be any finite numbers, however large. The head maps them to a density whose log_prob is finite
    wherever the true one is, in float32 and float64; half precision is upcast to float32. Non-finite raw parameters are
    refused with a `ValueError` that names the first bad batch row. A batch may have any shape and may be empty. A
    density may be 0 for some real numbers, such as negative ones; `mode=check` then needs possible targets
    (`values` of `framework.testing.rows.HeadRow`).
    """

    group: ClassVar[str] = "density_head"
    bibtex: ClassVar[str]
    """Citation of the method: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""
    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {}
    """Attributes that trade error for run time, each with its useful values in ascending order.

    An example is {"samples": (1, 3, 10, 30)}. They may be set at any time after training. A head without such
    attributes has {}.
    """
    direct: ClassVar[bool] = False
    """True if the last encoder's features are the raw parameters, without a linear layer.

    An example is a head behind an encoder that returns an image. The encoder must then return `size` features.
    """
    size: int
    """Number of raw parameters that the head reads per sample, > 0; set by the constructor."""
    backbones: tuple[int, ...] = ()
    """Number of raw parameters from each of several separate networks, in the order of the raw parameters.

    The model has one network for each entry, and the entries add up to `size`. With (), one network gives all raw
    parameters. The constructor may set the attribute.
    """

    @property
    def raw_shape(self) -> tuple[int, ...]:
        """Shape of the raw parameters of one sample; `(size,)` by default.

        A direct head that reads an image overrides it, such as (channel, height, width). Its methods then read raw
        parameters of shape (*batch, channel, height, width), and the model reshapes features only if they have another
        shape. Heads that are not direct, and components of other heads, read vectors.
        """
        return (self.size,)

    @abstractmethod
    def forward(self, raw: Float[Tensor, "*batch size"]) -> Distribution:
        """Return the density over the target for raw parameters; called in training, testing and prediction.

        In training mode the density may be a cheaper one than in evaluation (fewer samples). Random numbers come from
        torch's global generator, which the framework seeds before every step.
        """

    def loss(self, raw: Float[Tensor, "*batch size"], target: Tensor) -> Float[Tensor, "*batch"]:
        """Return the training loss per sample in nats, differentiable in `raw`; the framework takes the mean.

        The default is the negative log-likelihood, `-self(raw).log_prob(target)`. A variational head returns its
        negative bound instead.
        """
        return -self(raw).log_prob(target)

    def component_offsets(self, count: int) -> Float[Tensor, "count size"]:
        """Return offsets of raw parameters with which `count` densities of this head start at different places.

        A mixture adds them to the raw parameters of its components, because equal components would learn the same. The
        default draws each number from N(0, 1). A head that knows the space of its target returns offsets that spread
        the densities evenly over this space. Their numbers have a mean square of about 1.

        Args:
            count: number of components, at least 1.
        """
        return torch.randn(count, self.size)

    def calibrate(self, raw: Float[Tensor, "batch size"], target: Tensor) -> None:
        """Fit in place the parameters that gradients do not train, such as one concentration for all inputs.

        Thesis eq. 3.5 has such a concentration. The framework calls this method once after training, in evaluation mode
        and without gradient, with the whole validation split. Fitted values are buffers, so that the checkpoint stores
        them. The default does nothing.
        """


class Fitted(ABC):
    """Additional base class of a density head that is fitted to the whole training split at once, not by gradient.

    Trees are an example. No linear layer precedes the head: it reads the features as they are, and its `size` is the
    number of features, 0 before the fit. The encoders before the head must not have parameters that are trained. The
    head's state may have any shape: `load_state_dict` of a newly built head accepts every stored shape.
    """

    remark: str = ""
    """A sentence for the user about the result of `fit`; "" if there is nothing to report.

    Runs print it, and checkpoints store it.
    """

    @abstractmethod
    def fit(self, features: Float[Tensor, "sample size"], target: Tensor, seed: int) -> None:
        """Fit the head to all training samples, in place.

        Args:
            features: features of the training split.
            target: targets of the same samples, (sample, *event).
            seed: seed of random numbers; the members of an ensemble get different seeds.
        """
