"""Pose and shape of a registered mesh, whose vertices are those of the body, by nonlinear least squares."""

from dataclasses import replace
from typing import NamedTuple

import torch
from jaxtyping import Float
from scipy.spatial.transform import Rotation
from torch import Tensor

from framework.bodies.body import Body, BodyModel
from framework.errors import DataError

OFF = 0.01
"""Standard deviation, metres, of the distance between mesh and model, due to clothes, hair and registration."""
INDEPENDENT = 35
"""Number of vertex errors of a mesh that are treated as independent: vertices under one garment have similar errors."""
BENT = 0.7
"""Prior standard deviation, radians, of every joint except the root; the prior spreads a bend over several joints."""
STEPS = 60
ENOUGH = 1e-6
"""Size of a step below which the search ends, in radians for rotations, metres, or standard deviations of shape."""
MOST = 2_500
"""Largest number of vertices that a fit uses; if a mesh has more vertices, the fit uses every n-th of them."""
STEP = 1e-5
"""Step of the central differences by which the model is differentiated.

The unit is radians for joint rotations, metres for the translation, and standard deviations for shape coefficients.
"""
TOGETHER = 24
"""Number of parameters by which the model is differentiated at once."""


class MeshFit(NamedTuple):
    """Fit of a body to a mesh: the arguments of BodyModel, float64, as a batch of one.

    Attributes:
        shape: shape coefficients.
        pose: joint rotations, axis times angle, radians.
        translation: translation of the whole body, metres.
        error: root mean square distance between the vertices of the fitted body and those of the mesh, metres.
    """

    shape: Float[Tensor, "1 shape"]
    pose: Float[Tensor, "1 joint 3"]
    translation: Float[Tensor, "1 3"]
    error: float


class _Problem(NamedTuple):
    """Least-squares problem of fitting a body to a mesh; its parameters are pose, translation and shape, in order."""

    model: BodyModel
    vertices: Float[Tensor, "vertex 3"]
    prior: Float[Tensor, "number"]

    def parts(self, numbers: Float[Tensor, "batch number"]) -> tuple[Tensor, Tensor, Tensor]:
        turned = 3 * len(self.model.parents)
        pose, translation, shape = numbers.tensor_split((turned, turned + 3), 1)
        return shape, pose.unflatten(1, (-1, 3)), translation

    def residuals(self, numbers: Float[Tensor, "number"]) -> Float[Tensor, "vertex 3"]:
        return self.model(*self.parts(numbers[None]))[0] - self.vertices

    def cost(self, numbers: Float[Tensor, "number"]) -> float:
        return float(self.residuals(numbers).square().sum() + (self.prior * numbers.square()).sum())

    def derivatives(self, numbers: Float[Tensor, "number"]) -> Float[Tensor, "coordinate number"]:
        """Return the derivatives of all vertex coordinates by all parameters.

        They are central differences, of TOGETHER parameters in one batch, and have some ten correct digits in float64.
        """
        columns = []
        for steps in (STEP * torch.eye(len(numbers)).to(numbers)).split(TOGETHER):
            after, before = (self.model(*self.parts(numbers + sign * steps)) for sign in (1, -1))
            columns.append((after - before).flatten(1) / (2 * STEP))
        return torch.cat(columns).T


@torch.no_grad()
def fit_mesh(body: Body, vertices: Float[Tensor, "vertex 3"], usual: float = 1.0) -> MeshFit:
    """Return the most probable pose, shape and translation of a body for a mesh (Levenberg-Marquardt; Moré 1978).

    The search starts from the joint rotations of `estimate_rotations`, so that any pose can be found, even that of a
    person who is upside down.

    Args:
        body: the body model; its shape coefficients have standard deviation 1 among people.
        vertices: vertices of the mesh, metres, in the order of the body's vertices.
        usual: weight of the prior on pose and shape; with 0 there is no prior, and only the vertices count.

    Raises:
        DataError: the mesh has another number of vertices, or numbers that are not finite.
    """
    if len(vertices) != len(body.template) or not vertices.isfinite().all():
        raise DataError(
            f"A mesh has {len(vertices)} vertices, of which {int((~vertices.isfinite()).any(1).sum())} are not "
            f"finite; expected the {len(body.template)} vertices of {body.source} with finite coordinates in metres. "
            "Register the mesh to that body."
        )
    step = -(-len(vertices) // MOST)
    looked_at = {
        name: getattr(body, name)[::step]
        for name in ("template", "weights", "shapes", "pose_shapes")
        if getattr(body, name) is not None
    }
    model = BodyModel(replace(body, faces=body.faces[:0], uv=None, uv_faces=None, **looked_at)).double()
    vertices = vertices[::step].double()
    joints, shapes = len(body.parents), body.shapes.shape[-1]
    prior = vertices.new_full((joints + 1, 3), BENT**-2)
    prior[[body.parents.index(-1), -1]] = 0  # rotation and translation of the whole body are free
    prior = torch.cat([prior.flatten(), vertices.new_ones(shapes)]) * (
        usual * OFF**2 * len(vertices) / INDEPENDENT
    )
    problem = _Problem(model, vertices, prior)
    start = torch.cat([estimate_rotations(model, vertices).flatten(), vertices.new_zeros(3 + shapes)])
    start[3 * joints :][:3] = -problem.residuals(start).mean(0)
    numbers = _minimise(problem, start)
    error = float(problem.residuals(numbers).square().sum(1).mean().sqrt())
    return MeshFit(*problem.parts(numbers[None]), error)


def _minimise(problem: _Problem, numbers: Float[Tensor, "number"]) -> Float[Tensor, "number"]:
    damping, cost = 1e-3, problem.cost(numbers)
    for _ in range(STEPS):
        slopes = problem.derivatives(numbers)
        curvature = slopes.T @ slopes + problem.prior.diag()
        uphill = slopes.T @ problem.residuals(numbers).flatten() + problem.prior * numbers
        while True:
            # parameters without influence have no curvature of their own
            scaled = curvature + (damping * curvature.diagonal() + 1e-9).diag()
            step = -torch.linalg.solve(scaled, uphill)
            tried = problem.cost(numbers + step)
            if tried <= cost or damping > 1e10:
                break
            damping *= 4
        if tried > cost:
            break
        numbers, cost, damping = numbers + step, tried, max(damping / 9, 1e-12)
        if float(step.abs().max()) < ENOUGH:
            break
    return numbers


def estimate_rotations(model: BodyModel, vertices: Float[Tensor, "vertex 3"]) -> Float[Tensor, "joint 3"]:
    """Return the rotation of each joint relative to its parent joint, as axis times angle, radians.

    The rotation of a joint relative to the world is the one that best maps the template's vertices to their positions
    in the mesh, weighted by how much the vertices follow the joint (Kabsch 1976). For the root all vertices have equal
    weights. A joint with too few vertices to determine a rotation has the rotation 0 relative to its parent.
    """
    template = model.template.unflatten(0, (3, -1)).T
    upright = torch.eye(3).to(vertices)
    turned = [upright] * len(model.parents)
    vectors = torch.zeros(len(model.parents), 3).to(vertices)
    for level, parents in model.levels:
        for joint, parent in zip(level, parents, strict=True):
            above = turned[parent] if parent >= 0 else upright
            weights = model.weights[joint].square() if parent >= 0 else torch.ones_like(model.weights[joint])
            total = weights.sum()
            turned[joint] = above
            if total < 3:
                continue
            template_points, mesh_points = (
                points - weights @ points / total for points in (template, vertices)
            )
            left, values, right = torch.linalg.svd(mesh_points.T @ (weights[:, None] * template_points))
            if values[1] < 1e-3 * values[0]:  # vertices on a line do not determine the rotation about it
                continue
            mirror = torch.ones_like(values)
            mirror[2] = torch.linalg.det(left @ right).sign()
            turned[joint] = left @ mirror.diag() @ right
            local = Rotation.from_matrix((above.T @ turned[joint]).numpy())
            vectors[joint] = torch.from_numpy(local.as_rotvec())
    return vectors
