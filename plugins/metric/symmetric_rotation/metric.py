"""Log-likelihood and spread of densities of rotations of symmetric objects (Murphy et al. 2021, §4.2)."""

import math
from typing import Annotated, ClassVar

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.distributions.checks import refuse_nan
from framework.distributions.circular import Circular
from framework.errors import ConfigError, DataError
from framework.geometry import quaternions
from framework.geometry.symmetry import GROUPS, nearest_distance
from framework.metric import Directions, Mean
from framework.prediction import Prediction
from framework.target import Target

ANGLES = ("azimuth", "elevation", "tilt")
FIELDS = ("symmetry_group", "true_rotation")
LOG_VOLUME = math.log(math.pi**2)
"""Logarithm of the volume of all rotations in the convention of Murphy et al.; the uniform density has -2.29 nats."""
LOG_CHART = math.log(8 * math.pi**2)
"""Logarithm of ∫ cos e da de dt over all azimuths a, elevations e and tilts t."""


class SymmetricRotation(Mean):
    """Log-likelihood of rotations, its distance from the exact optimum, and the spread around equivalent rotations.

    The metric reads the batch fields "symmetry_group" (int64, an index into `framework.geometry.symmetry.GROUPS`),
    "true_rotation" (the quaternion R of the object in the image, (batch, 4)) and, if the labels have a known density,
    "true_log_density" (nats, with respect to the rotation-invariant measure of total mass 1). All results are means.

    - `rotation_log_likelihood`: log-density of the label with respect to the volume in which all rotations measure π²,
      nats. Murphy et al. use this convention: the uniform density has -log π² = -2.29 nats. A density p per radian of
      azimuth, elevation e and tilt becomes 8 p / cos e. A density that gives mass to elevations outside of ±π/2
      describes a rotation by two triples of angles, and the densities of both triples are added.
    - `optimum`: the same log-density under the exact density of the labels; NaN if it is not known.
    - `optimum_gap`: mean of `optimum` minus `rotation_log_likelihood`, label by label, so that the noise of the labels
      nearly cancels.
    - `spread_deg`: expected angle between a rotation drawn from the density and the nearest rotation R g, where g
      leaves the object unchanged, degrees, estimated from `draws` rotations.
    - `least_spread_deg`: the same angle for the labels, thus the spread of the exact density.

    Args:
        draws: number of rotations that are drawn from each density.

    Raises:
        ConfigError: the target does not consist of the angles azimuth, elevation and tilt, in this order; or, at the
            first update, the data have no field "symmetry_group" or "true_rotation".
        DataError: an entry of "symmetry_group" is not the index of a group.
        UserError: log-likelihoods are NaN.
    """

    bibtex = "murphy2021implicit"
    columns: ClassVar[dict[str, str]] = {
        "rotation_log_likelihood": "log-likelihood, SO(3)",
        "optimum_gap": "below optimum",
        "spread_deg": "spread °",
    }
    better: ClassVar[Directions] = {**dict.fromkeys(columns, "lower"), "rotation_log_likelihood": "higher"}

    def __init__(self, target: Target, *, draws: Annotated[int, Field(ge=1, le=100_000)] = 200) -> None:
        super().__init__()
        if target.kind != "angle" or target.names != ANGLES:
            raise ConfigError(
                f"metric symmetric_rotation requires the three angles {', '.join(ANGLES)}, but this data set's targets "
                f"are of kind {target.kind!r}: {target.listed_names}. Leave this metric out."
            )
        self.draws = draws
        self.start(5)

    def update(self, prediction: Prediction) -> None:
        missing = [name for name in FIELDS if name not in prediction.batch]
        if missing:
            raise ConfigError(
                f"metric symmetric_rotation requires the batch field {missing[0]!r}, but this data set does not know "
                f"the symmetry of its objects (fields: {', '.join(prediction.batch)}). Leave this metric out, or "
                "choose data=symmetric_solids."
            )
        if len(prediction.target) == 0:
            return
        truth, symmetry = (
            prediction.batch["true_rotation"].double(),
            prediction.batch["symmetry_group"].long(),
        )
        if symmetry.min() < 0 or symmetry.max() >= len(GROUPS):
            raise DataError(
                f"metric symmetric_rotation got symmetry groups from {int(symmetry.min())} to {int(symmetry.max())}; "
                f"expected 0 to {len(GROUPS) - 1} ({', '.join(GROUPS)}). Correct the field symmetry_group."
            )
        log_likelihood = refuse_nan(rotation_log_prob(prediction), "log-likelihoods of the rotations")
        optimum = prediction.batch.get(
            "true_log_density", torch.full_like(log_likelihood, torch.nan)
        ).double()
        optimum = optimum - LOG_VOLUME
        drawn = quaternions.of_viewpoint(prediction.density.sample(torch.Size((self.draws,))).double())
        label = quaternions.of_viewpoint(prediction.target.double())
        spread, least = torch.zeros_like(log_likelihood), torch.zeros_like(log_likelihood)
        for index in symmetry.unique().tolist():
            rows, group = symmetry == index, GROUPS[index]
            spread[rows] = nearest_distance(truth[rows], drawn[:, rows], group).mean(0)
            least[rows] = nearest_distance(truth[rows], label[rows], group)
        numbers = [log_likelihood, optimum, optimum - log_likelihood, spread.rad2deg(), least.rad2deg()]
        self.add_samples(torch.stack(numbers, -1))

    def compute(self) -> dict[str, Tensor]:
        names = ("rotation_log_likelihood", "optimum", "optimum_gap", "spread_deg", "least_spread_deg")
        mean, error = self.mean_and_error()
        results = dict(zip(names, mean, strict=True))
        return results | {f"{name}_sem": value for name, value in zip(names, error, strict=True)}


def rotation_log_prob(prediction: Prediction) -> Float[Tensor, "batch"]:
    """Return the log-density of the targets as rotations, nats, float64.

    The density is with respect to the rotation-invariant measure whose total is π², as in Murphy et al. 2021.
    """
    support = prediction.density.support
    log_prob = prediction.log_prob.double()
    if isinstance(support, Circular) and support.ranges is None:
        shift = prediction.target.new_tensor([math.pi, math.pi, math.pi])
        sign = prediction.target.new_tensor([1.0, -1.0, 1.0])
        other = prediction.density.log_prob(shift + sign * prediction.target).double()
        log_prob = torch.logaddexp(log_prob, other)
    log_cosine = torch.log(torch.cos(prediction.target[:, 1].double()).abs())
    return log_prob - log_cosine + LOG_CHART - LOG_VOLUME
