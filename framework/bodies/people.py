"""Random people: draws of shape and pose, for the default body or a body from a file."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from framework.bodies import body_files, poses
from framework.bodies.body import Body, with_joints
from framework.bodies.default_body import Traits, load_default_body


class BodyParameters(NamedTuple):
    """Shape coefficients and joint rotations of each person, in the form that BodyModel takes."""

    shape: Float[Tensor, "person shape"]
    pose: Float[Tensor, "person joint 3"]


@dataclass(frozen=True)
class People:
    """Distribution of random people.

    Attributes:
        body: body model of all people.
        traits: traits of the default body; None for a body from a file.
        spread: standard deviation of the first ten shape coefficients of a body from a file.
    """

    body: Body
    traits: Traits | None
    spread: float

    def draw(self, count: int, random: np.random.Generator) -> BodyParameters:
        """Return `count` random people, of the body's dtype."""
        if self.traits is None:
            shape = random.normal(0, self.spread, (count, min(10, self.body.shapes.shape[2])))
        else:
            shape = self.traits.coefficients(
                torch.from_numpy(sample_adults(self.traits.labels, count, random))
            ).numpy()
        pose = poses.rotations(self.body, poses.skeleton(self.body), poses.draw(count, random))
        dtype = self.body.template.dtype
        return BodyParameters(torch.from_numpy(shape.astype(dtype)), torch.from_numpy(pose.astype(dtype)))


def load_body(file: str | None) -> tuple[Body, Traits | None]:
    """Return the body in a file, which has no traits (None), or the default body and its traits if `file` is None.

    The default body keeps only the joints that poses rotate.
    """
    if file is not None:
        return body_files.read(Path(file).expanduser()), None
    body, traits = load_default_body()
    return with_joints(body, poses.JOINTS), traits


def sample_adults(
    labels: Sequence[str], count: int, random: np.random.Generator
) -> Float[np.ndarray, "person trait"]:
    """Return random traits of adults, in the order of `labels`.

    Gender is uniform in 0…1, and age in 0.6…0.95 (2/3: young, 1: old). The other traits are normal around 0.5 and
    clipped to 0.05…0.95.
    """
    values = random.random((count, len(labels)))
    for place, label in enumerate(labels):
        if label == "age":
            low, high = 0.6, 0.95
            values[:, place] = low + (high - low) * values[:, place]
        elif label != "gender":
            spread = 0.09 if label == "height" else 0.22
            values[:, place] = random.normal(0.5, spread, count).clip(0.05, 0.95)
    return values
