"""Articulated bodies: linear blend skinning with shape and pose blend shapes (thesis eq. 7.1-7.2)."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from framework.errors import ConfigError, DataError, did_you_mean

SLACK = 1e-3
"""Largest accepted difference between 1 and the sum of a vertex's skinning weights."""
ROUNDING = 1e-6
"""Largest difference between 1 and the sum of a vertex's weights with which the weights are left as they are.

If the difference is larger, the weights are divided by their sum.
"""


@dataclass(frozen=True)
class Body:
    """Arrays of a body model, float32 or float64, metres.

    Attributes:
        source: origin of the body, for messages.
        template: the vertices of the mean shape in the rest pose.
        faces: triangles as indices of vertices, corners counter-clockwise seen from outside.
        weights: skinning weights, ≥ 0: the share of each joint's motion that a vertex follows. The weights of a vertex
            sum to 1 (the constructor removes rounding errors of the sum).
        parents: parent of each joint, -1 for the only root.
        joints: positions of the joints in the rest pose of the mean shape.
        shapes, joint_shapes: displacement of vertices and joints by each shape coefficient.
        pose_shapes: displacement of vertices by each pose feature; None for a body without pose shapes. There are two
            kinds of features. Either there are 9 for each joint except the root: the elements of its rotation matrix
            less the identity, row by row (Loper et al. 2015, eq. 9). Or there are 4 for each joint except the root, its
            unit quaternion (x, y, z, w) less (0, 0, 0, 1), and then the second shape coefficient (Osman et al. 2020,
            eq. 4).
        names: names of the joints; empty if they have none.
        uv: texture coordinates, u to the right and v upwards; None for a body without texture.
        uv_faces: for each face, the rows of `uv` of its three corners; None for a body without texture.

    Raises:
        DataError: arrays do not fit together, a number is not finite, weights are negative or do not sum to 1, parents
            form no tree, or faces name vertices that do not exist.
    """

    source: str
    template: Float[np.ndarray, "_vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    weights: Float[np.ndarray, "_vertex _joint"]
    parents: tuple[int, ...]
    joints: Float[np.ndarray, "_joint 3"]
    shapes: Float[np.ndarray, "_vertex 3 _shape"]
    joint_shapes: Float[np.ndarray, "_joint 3 _shape"]
    pose_shapes: Float[np.ndarray, "_vertex 3 _feature"] | None = None
    names: tuple[str, ...] = ()
    uv: Float[np.ndarray, "_place 2"] | None = None
    uv_faces: Int[np.ndarray, "_face 3"] | None = None

    def __post_init__(self) -> None:
        vertices, joints, shapes = len(self.template), len(self.parents), self.shapes.shape[-1]
        wanted = {
            "template": (vertices, 3),
            "weights": (vertices, joints),
            "joints": (joints, 3),
            "shapes": (vertices, 3, shapes),
            "joint_shapes": (joints, 3, shapes),
        }
        if self.pose_shapes is not None:
            features = 4 * joints - 3 if self.pose_shapes.shape[-1] == 4 * joints - 3 else 9 * joints - 9
            wanted["pose_shapes"] = (vertices, 3, features)
        for name, shape in wanted.items():
            values = getattr(self, name)
            if values.shape != shape:
                raise DataError(
                    f"{self.source}: {name} has the shape {values.shape}; expected {shape} for {vertices} vertices, "
                    f"{joints} joints and as many shape coefficients as `shapes` has. Copy the file again from its "
                    "source."
                )
            if not np.isfinite(values).all():
                raise DataError(
                    f"{self.source}: {int((~np.isfinite(values)).sum())} numbers of {name} are not finite; expected "
                    "finite numbers. Copy the file again from its source."
                )
        if self.names and len(self.names) != joints:
            raise DataError(
                f"{self.source}: the body has {joints} joints, but {len(self.names)} names; expected one name for "
                "each joint. Copy the file again from its source."
            )
        self._check_weights()
        self._check_tree()
        if self.uv is not None and self.uv_faces is not None:
            self._check_places(self.uv, self.uv_faces)
        if self.faces.size and not (self.faces.min() >= 0 and self.faces.max() < vertices):
            raise DataError(
                f"{self.source}: the faces refer to the vertices {self.faces.min()} to {self.faces.max()}, but the "
                f"vertices are numbered 0 to {vertices - 1}. Copy the file again from its source."
            )

    def _check_weights(self) -> None:
        total = self.weights.sum(1, dtype=np.float64, keepdims=True)
        if (self.weights < 0).any() or (np.abs(total - 1) > SLACK).any():
            worst = int(np.abs(total[:, 0] - 1).argmax())
            raise DataError(
                f"{self.source}: the smallest skinning weight is {self.weights.min():g}, and the weights of vertex "
                f"{worst} (counted from 0) sum to {total[worst, 0]:g}; expected no weight below 0, and sums of 1. Copy "
                "the file again from its source."
            )
        if (np.abs(total - 1) > ROUNDING).any():
            object.__setattr__(self, "weights", (self.weights / total).astype(self.weights.dtype))

    def _check_places(self, uv: np.ndarray, uv_faces: np.ndarray) -> None:
        fits = uv.ndim == 2 and uv.shape[1] == 2 and uv_faces.shape == self.faces.shape
        if not fits or not np.isfinite(uv).all() or uv_faces.min(initial=0) < 0 or uv_faces.max() >= len(uv):
            raise DataError(
                f"{self.source}: the texture coordinates uv have the shape {uv.shape}, and their faces uv_faces the "
                f"shape {uv_faces.shape}; expected finite uv of shape (coordinates, 2), and uv_faces of shape "
                f"{self.faces.shape} that hold row numbers of uv. Copy the file again from its source."
            )

    def _check_tree(self) -> None:
        roots = [joint for joint, parent in enumerate(self.parents) if parent < 0]
        depths = _depths(self.parents)
        if len(roots) != 1 or max(self.parents, default=0) >= len(self.parents) or min(depths) < 0:
            raise DataError(
                f"{self.source}: the parents {self.parents} of the joints form no tree; expected a single joint "
                "whose parent is -1, from which all other joints descend. Copy the file again from its source."
            )


def _depths(parents: Sequence[int]) -> list[int]:
    """Return the number of steps from each joint up to a root, or -1 for a joint without a root above it."""
    depths = []
    for joint in range(len(parents)):
        depth, at = 0, joint
        while 0 <= parents[at] < len(parents) and depth <= len(parents):
            depth, at = depth + 1, parents[at]
        depths.append(depth if parents[at] < 0 else -1)
    return depths


def with_joints(body: Body, names: Sequence[str]) -> Body:
    """Return a copy of the body that has only the joints `names`.

    The vertices of a removed joint follow its nearest remaining ancestor rigidly. A pose in which only the remaining
    joints rotate gives the same vertices as before, with less computation. A body with pose shapes is refused, because
    pose shapes refer to all joints.

    Raises:
        ConfigError: a name is not the name of a joint, the root is not among the names, or the body has pose shapes.
    """
    for name in names:
        if name not in body.names:
            raise ConfigError(
                f"{body.source} has no joint {name!r}.{did_you_mean(name, body.names)} The joints of the "
                f"body are {', '.join(body.names)}."
            )
    kept_joints = [joint for joint, name in enumerate(body.names) if name in set(names)]
    root = body.parents.index(-1)
    if root not in kept_joints or body.pose_shapes is not None:
        raise ConfigError(
            f"{body.source}: joints can be left out only if the root {body.names[root]!r} remains and the body has "
            "no pose shapes, which refer to all joints. Keep the root, or keep all joints."
        )
    place = {joint: number for number, joint in enumerate(kept_joints)}
    weights = np.zeros((len(body.template), len(kept_joints)), body.weights.dtype)
    for joint in range(len(body.parents)):
        weights[:, place[_kept_above(body.parents, joint, place)]] += body.weights[:, joint]
    parents = [body.parents[joint] for joint in kept_joints]
    return replace(
        body,
        weights=weights,
        parents=tuple(-1 if up < 0 else place[_kept_above(body.parents, up, place)] for up in parents),
        joints=body.joints[kept_joints],
        joint_shapes=body.joint_shapes[kept_joints],
        names=tuple(body.names[joint] for joint in kept_joints),
    )


def _kept_above(parents: Sequence[int], joint: int, kept_joints: dict[int, int]) -> int:
    while joint not in kept_joints:
        joint = parents[joint]
    return joint


class BodyModel(nn.Module):
    """Differentiable model that returns the vertices of bodies from shape coefficients and joint rotations, in batches.

    The vertices are X = W(T + B_S(β) + B_P(θ), J(β), θ) (thesis eq. 7.1-7.2; Loper et al. 2015). β are the shape
    coefficients, θ the joint rotations (the pose), T the template, B_S the displacements by `shapes`, B_P those by
    `pose_shapes`, J the joints in the rest pose, and W is linear blend skinning. The rotation of a joint is relative to
    its parent; in the rest pose its axes are the world axes. For a pose of zeros the vertices are the template plus the
    displacements by shape, to the last bit if the body has no pose shapes.

    Args:
        body: arrays of the model; they become buffers, so that `.to` changes their type and device.
    """

    template: Tensor
    weights: Tensor
    joints: Tensor
    shapes: Tensor
    joint_shapes: Tensor
    pose_shapes: Tensor | None
    faces: Tensor

    def __init__(self, body: Body) -> None:
        super().__init__()
        self.parents = body.parents
        self.names = body.names
        self.quaternions = (
            body.pose_shapes is not None and body.pose_shapes.shape[-1] == 4 * len(body.parents) - 3
        )
        depths = _depths(body.parents)
        levels = [
            [joint for joint, depth in enumerate(depths) if depth == level]
            for level in range(max(depths) + 1)
        ]
        self.levels = [(level, [body.parents[joint] for joint in level]) for level in levels]
        arrays = {
            # one row for each coefficient: all x, then all y, then all z, in the order in which they are read
            "template": _rows(body.template[..., None])[0],
            "weights": body.weights.T,
            "joints": body.joints,
            "shapes": _rows(body.shapes),
            "joint_shapes": np.moveaxis(body.joint_shapes, 2, 0),
            "faces": body.faces.astype(np.int64),
        }
        if body.pose_shapes is not None:
            arrays["pose_shapes"] = _rows(body.pose_shapes)
        else:
            self.pose_shapes = None
        for name, values in arrays.items():
            self.register_buffer(name, torch.from_numpy(np.ascontiguousarray(values)), persistent=False)

    def forward(
        self,
        shape: Float[Tensor, "_batch _shape"],
        pose: Float[Tensor, "_batch _joint 3"],
        translation: Float[Tensor, "_batch 3"] | None = None,
        offsets: Float[Tensor, "_batch vertex 3"] | None = None,
    ) -> Float[Tensor, "batch vertex 3"]:
        """Return the posed vertices, metres, of the model's dtype.

        Args:
            shape: coefficients β. They may be fewer than the model has; the remaining coefficients are then 0.
            pose: θ, axis times angle of each joint, radians; angles above 2π are allowed.
            translation: translation of the whole body, metres.
            offsets: displacements of a person's vertices from those of the model, in the rest pose, metres; they
                describe, for example, clothes and hair.

        Raises:
            ValueError: the shapes are wrong, or numbers are not finite; the message names the first such row.
        """
        self._check(shape, pose, translation)
        count = shape.shape[1]
        rest = torch.addmm(self.template, shape, self.shapes[:count])
        # rotations in float64, because angles of many turns lose digits otherwise; there are few of them
        turns = rotation_minus_identity(pose.double())
        if self.pose_shapes is not None:
            rest = rest + self._features(turns, pose, shape) @ self.pose_shapes
        rest = rest.unflatten(1, (3, -1))
        if offsets is not None:
            rest = rest + offsets.transpose(1, 2)
        blended = self._blended(shape, turns)
        # Σ_j w_j (R_j x + t_j) = x + Σ_j w_j ((R_j - 1) x + t_j), which is exactly x if no joint rotates
        moved = (blended[:, :9].unflatten(1, (3, 3)) * rest[:, None]).sum(2)
        posed = rest + (moved + blended[:, 9:])
        if translation is not None:
            posed = posed + translation[..., None]
        return posed.transpose(1, 2).contiguous()

    def skinning(
        self, shape: Float[Tensor, "batch shape"], pose: Float[Tensor, "batch joint 3"]
    ) -> Float[Tensor, "batch vertex 3 3"]:
        """Return Σ_j w_j R_j of each vertex, the linear part of its skinning transform (W of thesis eq. 7.1).

        w_j is the vertex's skinning weight of joint j, and R_j the rotation of joint j relative to the world. `shape`
        and `pose` are arguments of `forward`.
        """
        self._check(shape, pose, None)
        blended = self._blended(shape, rotation_minus_identity(pose.double()))[:, :9]
        return blended.mT.unflatten(2, (3, 3)) + torch.eye(3).to(blended)

    def rest_joints(self, shape: Float[Tensor, "batch shape"]) -> Float[Tensor, "batch joint 3"]:
        """Return J(β), joint positions in the rest pose, metres."""
        return self.joints + torch.einsum("bs,sjk->bjk", shape, self.joint_shapes[: shape.shape[1]])

    def posed_joints(
        self, shape: Float[Tensor, "batch shape"], pose: Float[Tensor, "batch joint 3"]
    ) -> Float[Tensor, "batch joint 3"]:
        """Return the positions of the joints in a pose, metres; `shape` and `pose` are arguments of `forward`."""
        self._check(shape, pose, None)
        joints = self.rest_joints(shape).double()
        transforms = self._transforms(shape, rotation_minus_identity(pose.double()))
        moved = torch.einsum("bjmn,bjn->bjm", transforms[..., :9].unflatten(-1, (3, 3)), joints)
        return (joints + moved + transforms[..., 9:]).to(self.template.dtype)

    def _blended(self, shape: Tensor, turns: Tensor) -> Float[Tensor, "batch 12 vertex"]:
        """Return Σ_j w_j (R_j - 1, t_j) of each vertex: skinning weights w_j times the results of `_transforms`."""
        return self._transforms(shape, turns).to(self.weights.dtype).transpose(1, 2) @ self.weights

    def _transforms(self, shape: Tensor, turns: Tensor) -> Float[Tensor, "batch joint 12"]:
        """Return (R - 1, t) of each joint, float64: the transform x → R x + t from the rest pose to the pose.

        The transform includes the rotations of the joint and of all its ancestors. `turns` are the rotations relative
        to the parents, minus the identity matrix.
        """
        joints = self.rest_joints(shape).double()
        rotations = list(turns.unbind(1))
        shifts = list(joints.unbind(1))
        for level, above in self.levels:
            if above[0] < 0:  # the root rotates about its own position: R j + t = j
                rotation = turns[:, level]
                shift = -(rotation @ joints[:, level, :, None])[..., 0]
            else:
                up = torch.stack([rotations[joint] for joint in above], 1)
                local = turns[:, level]
                rotation = up + local + up @ local  # (1 + U)(1 + L) - 1
                # a joint's own rotation does not move it: R j + t = R_up j + t_up
                shift = torch.stack([shifts[joint] for joint in above], 1)
                shift = shift + ((up - rotation) @ joints[:, level, :, None])[..., 0]
            for number, joint in enumerate(level):
                rotations[joint], shifts[joint] = rotation[:, number], shift[:, number]
        return torch.cat([torch.stack(rotations, 1).flatten(2), torch.stack(shifts, 1)], -1)

    def _features(self, turns: Tensor, pose: Tensor, shape: Tensor) -> Float[Tensor, "batch feature"]:
        free_joints = [joint for joint, parent in enumerate(self.parents) if parent >= 0]
        if not self.quaternions:
            return turns[:, free_joints].flatten(1).to(self.template.dtype)
        second = shape[:, 1:2] if shape.shape[1] > 1 else shape.new_zeros(len(shape), 1)
        features = quaternion_minus_identity(pose[:, free_joints].double()).flatten(1)
        return torch.cat([features.to(shape.dtype), second], 1)

    def _check(self, shape: Tensor, pose: Tensor, translation: Tensor | None) -> None:
        batch, most, joints = len(shape), len(self.shapes), len(self.parents)
        fits = shape.dim() == 2 and shape.shape[1] <= most and pose.shape == (batch, joints, 3)
        if not fits or (translation is not None and translation.shape != (batch, 3)):
            moved = (
                ""
                if translation is None
                else f"; translation {tuple(translation.shape)}, expected (batch, 3)"
            )
            raise ValueError(
                f"The body parameters have wrong shapes: shape parameters {tuple(shape.shape)}, expected (batch, at "
                f"most {most}); pose {tuple(pose.shape)}, expected (batch, {joints}, 3){moved}. Use the same batch "
                "size for all of them."
            )
        for name, values in (("shape", shape), ("pose", pose), ("translation", translation)):
            # angles whose squares are infinite in float64 are also refused
            if values is not None and not (finite := values.double().square().isfinite()).all():
                row = int((~finite.flatten(1).all(1)).nonzero()[0])
                raise ValueError(
                    f"The body parameter {name} has a number that is not finite, or is too large, in batch row "
                    f"{row}; expected finite numbers below 1e150. Correct this row."
                )


def _rows(values: np.ndarray) -> np.ndarray:
    """Rearrange an array of shape (vertex, 3, row) to (row, 3 · vertex)."""
    return np.moveaxis(values, 0, 2).transpose(1, 0, 2).reshape(values.shape[2], -1)


def rotation_minus_identity(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3 3"]:
    """Return R - 1 of rotations given as axis times angle, radians, accurate also for tiny angles.

    For a vector v of length θ, R - 1 = (sin θ / θ) K + ((1 - cos θ) / θ²) K², where K is the matrix with K x = v × x
    (Rodrigues; Murray, Li & Sastry 1994, eq. 2.14).
    """
    x, y, z = vectors.unbind(-1)
    zero = torch.zeros_like(x)
    cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))
    square = vectors.square().sum(-1)
    first = sine_over_angle(square)[..., None, None]
    half = sine_over_angle(square / 4)[..., None, None]  # (1 - cos θ) / θ² = (sin(θ/2) / (θ/2))² / 2
    return first * cross + half.square() / 2 * (cross @ cross)


def quaternion_minus_identity(vectors: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 4"]:
    """Return unit quaternions (x, y, z, w - 1) of rotations given as axis times angle, radians."""
    square = vectors.square().sum(-1, keepdim=True)
    quarter = sine_over_angle(square / 16)
    # cos(θ/2) - 1 = -2 sin²(θ/4)
    return torch.cat([sine_over_angle(square / 4) * vectors / 2, -quarter.square() * square / 8], -1)


def sine_over_angle(square: Float[Tensor, "*batch"]) -> Float[Tensor, "*batch"]:
    """Return sin θ / θ for θ² in `square`; the function is also smooth at 0."""
    small = square < 1e-2
    root = square.where(~small, 1).sqrt()
    # the series of sin θ / θ; its remainder is below 1e-20 up to θ² = 1e-2
    t = square.where(small, 0)
    series = 1 - t / 6 * (1 - t / 20 * (1 - t / 42 * (1 - t / 72 * (1 - t / 110))))
    return series.where(small, root.sin() / root)
