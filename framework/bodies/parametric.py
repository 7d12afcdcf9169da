"""A coloured body that is a function of few parameters: position, movements of the main joints, and shape."""

import math
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from pydantic import Field
from torch import Tensor

from framework.bodies import poses
from framework.bodies.body import Body, BodyModel, rotation_minus_identity, with_joints
from framework.bodies.default_body import Traits
from framework.bodies.people import load_body
from framework.geometry.camera import Camera


class Turn(NamedTuple):
    """Rotation of a joint that a movement causes.

    Attributes:
        movement: name of the movement in framework.bodies.poses.
        role: name of the field of framework.bodies.poses.Skeleton that holds the rotated joint, or joints.
        axis: axis of the rotation, "x", "y" or "z"; "hinge" for the axis about which the elbow bends.
        sign: 1 if a positive angle of the movement rotates counter-clockwise about the axis, -1 if clockwise.
    """

    movement: str
    role: str
    axis: str
    sign: float = 1.0


CENTRAL = (
    Turn("turn", "spine", "y"),
    Turn("lean", "spine", "x"),
    Turn("bend", "spine", "z"),
    Turn("look", "neck", "y"),
    Turn("nod", "neck", "x"),
    Turn("tilt", "neck", "z"),
)
SIDED = (
    Turn("swing", "arm", "x"),
    Turn("forward", "arm", "y", -1.0),
    Turn("raise", "arm", "z"),
    Turn("elbow", "elbow", "hinge"),
    Turn("hip", "hip", "x", -1.0),
    Turn("spread", "hip", "z"),
    Turn("knee", "knee", "x"),
)
"""Rotations that movements of the left side cause; on the right side, rotations about y and z have the opposite sign.

If a joint has several movements, the last one in this tuple is applied first.
"""
PLACE = tuple(f"{quantity}_{axis}" for quantity in ("rotation", "translation") for axis in "xyz")
TRAITS = {"gender": 0.29, "muscle": 0.22, "weight": 0.22, "proportions": 0.22}
"""Traits of the default body that are parameters, with their standard deviations among people.

Height is not among them: an image determines the ratio of a body's size to its distance, but hardly the size itself.
"""
FURTHEST = 4.0
"""Largest difference of a movement from its mean, in standard deviations."""
STEP = 1e-5
"""Step of the central differences by which the joints' transforms are differentiated, in each parameter's unit."""
SHAPES = 4
"""Number of free shape coefficients of a body from a file."""
ImageSide = Annotated[int, Field(ge=8, le=1024, multiple_of=4)]
"""Height or width, pixels, of images that show the body."""


class ParametricBody:
    """Coloured body whose vertices are a function of free parameters.

    The parameters are, in the order of `names`, the rotation of the whole body about its root (axis times angle,
    radians, world axes), its translation (metres), the differences of movements of framework.bodies.poses from their
    means (radians), and shape coefficients (standard deviations). Parameters of 0 give an average person in the mean
    pose. The mean pose is also the rest pose for skinning. Joints that no parameter moves keep the mean pose.

    Args:
        file: file of a body model of the SMPL family; None: the default body.

    Attributes:
        spread: standard deviation of each parameter among random people; 1 for rotation and translation.
        limits: smallest and largest value of each parameter.

    Raises:
        DataError: the body is not available or cannot be read.
    """

    template: Tensor
    shapes: Tensor
    weights: Tensor
    joints: Tensor
    joint_shapes: Tensor
    axes: Tensor
    faces: Tensor
    colors: Tensor
    spread: Tensor
    limits: Tensor

    def __init__(self, file: str | None = None) -> None:
        body, traits = load_body(file)
        self.source = body.source
        where = poses.skeleton(body)
        body, shape_names = _in_mean_pose(body, traits, where)
        joint_of_role = {
            "root": where.root,
            "spine": where.spine[len(where.spine) // 2],
            "neck": where.neck[0],
        }
        for role in ("arm", "elbow", "hip", "knee"):
            joint_of_role |= {
                f"{side} {role}": getattr(where, role)[number]
                for number, side in enumerate(("left", "right"))
            }
        joint_names = body.names
        body = with_joints(body, [joint_names[joint] for joint in joint_of_role.values()])
        place = {role: body.names.index(joint_names[joint]) for role, joint in joint_of_role.items()}
        self.parents = body.parents
        self.order = _parents_first(body.parents)
        moves, limits = _free_movements(body, place)
        self.slots = [joint for joint, _, _ in moves]
        self.names = (*PLACE, *(name for *_, name in moves), *shape_names)
        arrays = {
            "template": body.template.T.astype(np.float32),
            "shapes": body.shapes.transpose(2, 1, 0).reshape(len(shape_names), -1).astype(np.float32),
            "weights": body.weights.T.astype(np.float32),
            "joints": body.joints.astype(np.float64),
            "joint_shapes": np.moveaxis(body.joint_shapes, 2, 0).astype(np.float64),
            "axes": np.stack([axis for _, axis, _ in moves]),
            "faces": body.faces.astype(np.int32),
            "colors": paint(body),
        }
        spans = [limits[name.rpartition("_")[2]] for *_, name in moves]
        spread = (
            [1.0] * 6 + [np.radians(deviation) for _, deviation, _, _ in spans] + [1.0] * len(shape_names)
        )
        bounds = (
            [(-np.inf, np.inf)] * 6 + [_bounds(*span) for span in spans] + [(-2.0, 2.0)] * len(shape_names)
        )
        arrays |= {"spread": np.array(spread), "limits": np.array(bounds)}
        for name, values in arrays.items():
            setattr(self, name, torch.from_numpy(np.ascontiguousarray(values)))

    def camera(self, height: int, width: int) -> Camera:
        """Return a camera in front of the body, which sees the whole body if all parameters of the body are 0.

        The image has `height` × `width` pixels. The distance of the camera is 1.2 times the height of the body.
        """
        low, high = float(self.template[1].min()), float(self.template[1].max())
        return Camera(
            rotation=torch.tensor([1.0, -1.0, -1.0]).diag(),
            translation=torch.tensor([0.0, (low + high) / 2, 1.2 * (high - low)]),
            focal=(0.9 * height, 0.9 * height),
            principal=((width - 1) / 2, (height - 1) / 2),
            height=height,
            width=width,
        )

    def __call__(self, numbers: Float[Tensor, "number"]) -> Float[Tensor, "vertex 3"]:
        """Return the vertices for the parameters `numbers` (in the order of `names`), metres, float32."""
        return self.vertices(numbers, slice(None))

    def vertices(self, numbers: Float[Tensor, "number"], chosen: slice | Tensor) -> Float[Tensor, "vertex 3"]:
        """Return the vertices `chosen` (indices or a slice) for the parameters `numbers`, metres, float32."""
        numbers = numbers.double()
        rest = self._rest(numbers, chosen)
        blended = self._transforms(numbers).to(rest.dtype).T @ self.weights[:, chosen]
        return ((blended[:9].unflatten(0, (3, 3)) * rest).sum(1) + blended[9:]).T

    @torch.no_grad()
    def derivatives(
        self, numbers: Float[Tensor, "number"], chosen: Int[Tensor, "chosen"]
    ) -> Float[Tensor, "chosen 3 number"]:
        """Return the derivatives of the positions of the vertices `chosen` by every parameter, float32.

        The derivatives of the joints' transforms are central differences in float64, computed in one batch. Skinning is
        linear in the transforms, so it maps their derivatives to those of the vertices.
        """
        numbers = numbers.double()
        steps = STEP * torch.eye(len(numbers), dtype=torch.float64, device=numbers.device)
        ends = self._transforms(torch.cat([numbers + steps, numbers - steps])).unflatten(0, (2, -1))
        along = ((ends[0] - ends[1]) / (2 * STEP)).float()
        weights, rest = self.weights[:, chosen], self._rest(numbers, chosen)
        moved = torch.einsum("pja,jv->apv", along, weights)
        turned = torch.einsum("abpv,bv->vap", moved[:9].unflatten(0, (3, 3)), rest)
        derivatives = turned + moved[9:].permute(2, 0, 1)
        blended = (self._transforms(numbers).float().T[:9] @ weights).unflatten(0, (3, 3))
        shapes = self.shapes.unflatten(1, (3, -1))[:, :, chosen]
        derivatives[:, :, 6 + len(self.slots) :] += torch.einsum("abv,sbv->vas", blended, shapes)
        return derivatives

    def _rest(self, numbers: Tensor, chosen: slice | Tensor) -> Float[Tensor, "3 chosen"]:
        """Return the vertices `chosen` in the mean pose, for the shape coefficients in `numbers`."""
        shape = numbers[6 + len(self.slots) :].to(self.template.dtype)
        return (self.template + (shape @ self.shapes).unflatten(0, (3, -1)))[:, chosen]

    def _transforms(self, numbers: Float[Tensor, "*batch number"]) -> Float[Tensor, "*batch joint 12"]:
        """Return (R, t) of each joint: the transform x → R x + t from the mean pose to the pose of `numbers`.

        The transform includes the rotations of the joint and of all its ancestors.
        """
        count = len(self.slots)
        joints = self.joints + torch.einsum("...s,sjk->...jk", numbers[..., 6 + count :], self.joint_shapes)
        about = torch.cat([numbers[..., None, :3], self.axes * numbers[..., 6 : 6 + count, None]], -2)
        identity = torch.eye(3, dtype=torch.float64, device=numbers.device)
        turns = (rotation_minus_identity(about) + identity).unbind(-3)
        local: dict[int, Tensor] = {self.order[0]: turns[0]}
        for joint, turn in zip(self.slots, turns[1:], strict=True):
            local[joint] = local[joint] @ turn if joint in local else turn
        rotations: dict[int, Tensor] = {}
        places: dict[int, Tensor] = {}
        for joint in self.order:
            above = self.parents[joint]
            if above < 0:
                rotations[joint], places[joint] = local[joint], joints[..., joint, :] + numbers[..., 3:6]
            else:
                bone = joints[..., joint, :] - joints[..., above, :]
                rotations[joint] = rotations[above] @ local[joint]
                places[joint] = places[above] + (rotations[above] @ bone[..., None])[..., 0]
        turned = torch.stack([rotations[joint] for joint in range(len(self.parents))], -3)
        moved = torch.stack([places[joint] for joint in range(len(self.parents))], -2)
        shift = moved - (turned @ joints[..., None])[..., 0]
        return torch.cat([turned.flatten(-2), shift], -1)


def _in_mean_pose(body: Body, traits: Traits | None, where: poses.Skeleton) -> tuple[Body, tuple[str, ...]]:
    """Return a body whose rest pose is the mean pose, and the names of its few shape coefficients."""
    usual = [limits[0] for limits in (*poses.CENTRAL.values(), *2 * (*poses.SIDED.values(),))]
    pose = torch.from_numpy(poses.rotations(body, where, np.array([usual], float))).to(torch.float64)
    if traits is None:
        names = tuple(f"shape_{number}" for number in range(min(SHAPES, body.shapes.shape[2])))
        average = torch.zeros(1, body.shapes.shape[2], dtype=torch.float64)
        steps = torch.eye(body.shapes.shape[2], dtype=torch.float64)[: len(names)]
    else:
        names = tuple(TRAITS)
        labels = list(traits.labels)
        middle = torch.full((1 + 2 * len(names), len(labels)), 0.5, dtype=torch.float64)
        middle[:, labels.index("age")] = 0.75
        for number, name in enumerate(names):
            middle[1 + 2 * number, labels.index(name)] = 0.25
            middle[2 + 2 * number, labels.index(name)] = 0.75
        coefficients = traits.coefficients(middle)
        average = coefficients[:1]
        steps = torch.stack(
            [coefficients[2 + 2 * number] - coefficients[1 + 2 * number] for number in range(len(names))]
        )
        steps = steps * 2 * torch.tensor(list(TRAITS.values()), dtype=torch.float64)[:, None]
    model = BodyModel(body).double()
    people = torch.cat([average, average + steps])
    bent = pose.expand(len(people), -1, -1)
    vertices, joints = model(people, bent).numpy(), model.posed_joints(people, bent).numpy()
    kind = body.template.dtype
    return replace(
        body,
        template=vertices[0].astype(kind),
        joints=joints[0].astype(kind),
        shapes=np.moveaxis(vertices[1:] - vertices[:1], 0, 2).astype(kind),
        joint_shapes=np.moveaxis(joints[1:] - joints[:1], 0, 2).astype(kind),
        pose_shapes=None,
        names=body.names or tuple(f"joint_{number}" for number in range(len(body.parents))),
    ), names


def _free_movements(
    body: Body, place: dict[str, int]
) -> tuple[list[tuple[int, np.ndarray, str]], dict[str, poses.Range]]:
    """Return joint, axis and name of every free movement, and the `Range` of all movements by name.

    `place` maps a role, such as "left arm", to the number of a joint.
    """
    axes = dict(zip("xyz", np.eye(3), strict=True))
    moves = [(place[turn.role], turn.sign * axes[turn.axis], turn.movement) for turn in CENTRAL]
    for side, mirror in (("left", 1.0), ("right", -1.0)):
        shoulder, elbow = (body.joints[place[f"{side} {role}"]] for role in ("arm", "elbow"))
        for turn in SIDED:
            if turn.axis == "hinge":
                upper = (elbow - shoulder) / np.linalg.norm(elbow - shoulder)
                hinge = np.cross(upper, axes["z"])  # rotation about it moves a forearm to the front
                axis = hinge / np.linalg.norm(hinge)
            else:
                axis = axes[turn.axis] * turn.sign * (1.0 if turn.axis == "x" else mirror)
            moves.append((place[f"{side} {turn.role}"], axis, f"{side}_{turn.movement}"))
    return moves, poses.CENTRAL | poses.SIDED


def _bounds(
    usual: poses.Degrees, deviation: poses.Degrees, least: poses.Degrees, most: poses.Degrees
) -> tuple[float, float]:
    """Return the bounds of a movement relative to its mean, radians.

    They are the movement's own limits, but at most FURTHEST standard deviations from the mean.
    """
    far = FURTHEST * deviation
    return math.radians(max(least - usual, -far)), math.radians(min(most - usual, far))


def _parents_first(parents: tuple[int, ...]) -> list[int]:
    ordered_joints: list[int] = []
    while len(ordered_joints) < len(parents):
        ordered_joints += [
            joint
            for joint, up in enumerate(parents)
            if joint not in ordered_joints and (up < 0 or up in ordered_joints)
        ]
    return ordered_joints


def paint(body: Body) -> Float[np.ndarray, "vertex 4"]:
    """Return four channels of vertex colours: linear RGB, and a constant 1 that gives the silhouette.

    The colours are smooth and differ between all parts of the body, left and right, front and back.
    """
    random = np.random.default_rng(3)
    parts = random.uniform(0.25, 0.75, (len(body.parents), 3))
    colors = body.weights @ parts
    place = (body.template - body.template.mean(0)).astype(np.float64)
    # each colour channel has stripes of some 30 cm in its own direction, and a difference of front and back
    for channel, (frequency, phase) in enumerate(
        zip(((9, 6, 7), (-6, 8, 10), (5, -10, 8)), (0.3, 1.4, 2.6), strict=True)
    ):
        colors[:, channel] += 0.22 * np.sin(place @ np.array(frequency, float) + phase)
    colors += 0.12 * np.tanh(place[:, 2:] / 0.06) * np.array([1.0, -1.0, 0.5])
    return np.concatenate([colors.clip(0.02, 0.98), np.ones((len(colors), 1))], 1).astype(np.float32)


def parametric_body(file: str | None) -> ParametricBody:
    """Return the parametric body in a file, or the default body if `file` is None.

    The body is read once and shared, because data and density head use the same body. It is read again if the file has
    changed. Callers must not modify it.
    """
    known = None if file is None else Path(file).expanduser()
    return _read(file, known.stat().st_mtime_ns if known is not None and known.is_file() else None)


@cache
def _read(file: str | None, changed: int | None) -> ParametricBody:
    return ParametricBody(file)
