"""Principal directions of the shapes of bodies, scaled as in the SMPL family."""

from dataclasses import replace

import numpy as np
import torch

from framework.bodies.body import Body
from framework.bodies.default_body import Traits
from framework.bodies.people import sample_adults

COUNT = 10
"""Number of shape coefficients (thesis §7.3.1)."""
DRAWN = 400
"""Number of random adults from whom the directions are computed."""


def reduce_shapes(body: Body, traits: Traits | None) -> Body:
    """Return the body with at most COUNT shape coefficients, each of standard deviation 1 and of mean 0 among people.

    For a body from a file (`traits` is None), which has this scale already, only the first coefficients remain. For the
    default body, random adults are drawn. The mean of their vertices becomes the template, and the principal components
    of their vertices become the shapes, the largest first, with the sign that makes the person taller.
    """
    if traits is None:
        return replace(body, shapes=body.shapes[..., :COUNT], joint_shapes=body.joint_shapes[..., :COUNT])
    values = sample_adults(traits.labels, DRAWN, np.random.default_rng(0))
    people = traits.coefficients(torch.from_numpy(values)).numpy()
    mean = people.mean(0)
    spread = (people - mean) / np.sqrt(DRAWN - 1)
    # principal components of vertices, from the small Gram matrix of people's vertices
    shapes = body.shapes.reshape(-1, body.shapes.shape[2]).astype(np.float64)
    agreement = spread @ (shapes.T @ shapes) @ spread.T
    variance, shares = np.linalg.eigh(agreement)
    largest = np.argsort(-variance, kind="stable")[:COUNT]
    # for a unit eigenvector u with variance s², the direction spreadᵀ u moves vertices by s, one standard deviation
    directions = spread.T @ shares[:, largest]
    taller = np.ptp(body.template[:, 1] + body.shapes[:, 1] @ mean)
    for column in directions.T:
        if np.ptp(body.template[:, 1] + body.shapes[:, 1] @ (mean + column)) < taller:
            column *= -1
    kind = body.template.dtype
    return replace(
        body,
        template=(body.template + body.shapes @ mean).astype(kind),
        joints=(body.joints + body.joint_shapes @ mean).astype(kind),
        shapes=(body.shapes @ directions).astype(kind),
        joint_shapes=(body.joint_shapes @ directions).astype(kind),
    )
