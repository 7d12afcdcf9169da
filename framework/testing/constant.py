"""Model for tests of objectives: the same raw parameters for every input."""

from collections.abc import Iterable

from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.density_head import DensityHead
from framework.distributions.batch_shapes import Stacked
from framework.model import Predictor


class ConstantPredictor(Predictor):
    """A predictor that passes the same trained raw parameters to a head for every input, and records the inputs.

    Args:
        head: density head.
        raw: initial raw parameters, (size,), or (member, size) if `members`.
        members: whether the densities have a dimension for members, as those of an ensemble in training.

    Attributes:
        recorded: inputs of each call.
    """

    def __init__(self, head: DensityHead, raw: Tensor, members: bool = False) -> None:
        super().__init__()
        self.head = head
        self.raw = nn.Parameter(raw)
        self.members = members
        self.recorded: list[Tensor] = []

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the density for each input."""
        self.recorded.append(inputs.detach().clone())
        wide = self.raw.expand(len(inputs), *self.raw.shape)
        if self.members:
            return Stacked([self.head(wide[:, index]) for index in range(wide.shape[1])])
        return self.head(wide)

    forward = training_densities

    def loss(self, inputs: Tensor, target: Tensor) -> Tensor:
        """Return the negative log-likelihood of each target."""
        return -self(inputs).log_prob(target)

    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Fail, because objectives do not calibrate."""
        raise AssertionError("an objective does not calibrate")
