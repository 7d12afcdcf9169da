"""Base class of the density heads with a latent vector, and the settings that they share."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, ClassVar

from pydantic import Field

from framework.density_head import DensityHead
from framework.heads.parameters import require_trained
from framework.storage.limits import MOST_DRAWS
from plugins.density_head.latent.monte_carlo import Effort


@dataclass(frozen=True, kw_only=True)
class LatentSettings:
    """Size of the networks of a head with a latent vector z, and number of samples of z.

    Attributes:
        latent: dimensions of z.
        hidden: width of each network.
        training_samples: number S of samples of z in the training loss.
        samples: number S of samples of z in evaluation; may be set at any time.
        tolerance: largest estimated error of log_prob in evaluation, nats; may be set at any time. If it is set,
            log_prob first draws S samples and doubles them until its estimated error is below the tolerance. None: S
            samples.
    """

    latent: Annotated[int, Field(ge=1)]
    hidden: Annotated[int, Field(ge=1)] = 128
    training_samples: Annotated[int, Field(ge=1, le=MOST_DRAWS)]
    samples: Annotated[int, Field(ge=1, le=MOST_DRAWS)] = 500
    tolerance: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = None


class LatentHead(DensityHead):
    """Base class of the heads whose density is a mixture over a latent vector z.

    Args:
        settings: size of the networks, and number of samples of z.
        component: the head whose densities are mixed.
    """

    knobs: ClassVar[Mapping[str, tuple[int, ...]]] = {"samples": (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)}

    def __init__(self, settings: LatentSettings, component: DensityHead) -> None:
        super().__init__()
        self.latent = settings.latent
        self.hidden = settings.hidden
        self.training_samples = settings.training_samples
        self.samples = settings.samples
        self.tolerance = settings.tolerance
        self.component = require_trained(component)

    def effort(self) -> Effort:
        """Return the number of samples of z in evaluation, and the tolerance."""
        return Effort(self.samples, self.tolerance)
