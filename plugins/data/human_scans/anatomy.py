"""Anatomical coordinates of each vertex of a person: along an arm or a leg, height on the trunk, position on the head.

All coordinates are measured on the template of the body in its rest pose. Garments, hair and skin of all people in all
poses therefore use the same coordinates.
"""

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float

from framework.bodies.body import Body
from framework.bodies.poses import Skeleton, skeleton

AWAY = -1.0
"""Initial value of the coordinate along a limb, metres; below 0 a vertex lies before the limb or on another part."""


@dataclass(frozen=True)
class Anatomy:
    """Measures of each vertex of a body's sheet, metres, float32.

    The sheet is the mesh of the body whose edges are split in the middle (`framework.bodies.topologies.Sheet`).

    Attributes:
        place: position in the template: x to the left, y up, z to the front.
        arms, legs, head: share of the skinning weights that belongs to the joints of these parts.
        along_arm, along_leg: distance along the bones from the shoulder or from the hip; below 0 between the trunk and
            this joint, and on other parts of the body.
        on_head: x in half widths of the head, y from 0 (under the chin) to 1 (crown), z from -1 (back) to 1 (nose).
        elbow, wrist, knee, ankle: positions of these joints along arm and leg.
        waist, hips, chest, neck: heights on the trunk.
        neck_place: position of the lowest joint of the neck.
    """

    place: Float[np.ndarray, "vertices 3"]
    arms: Float[np.ndarray, "vertices"]
    legs: Float[np.ndarray, "vertices"]
    head: Float[np.ndarray, "vertices"]
    along_arm: Float[np.ndarray, "vertices"]
    along_leg: Float[np.ndarray, "vertices"]
    on_head: Float[np.ndarray, "vertices 3"]
    elbow: float
    wrist: float
    knee: float
    ankle: float
    hips: float
    waist: float
    chest: float
    neck: float
    neck_place: Float[np.ndarray, "3"]

    @property
    def on_arm(self) -> Bool[np.ndarray, "vertices"]:
        """Return a mask of the vertices that belong to an arm."""
        return self.arms > 0.5


def anatomy(body: Body, carried: Callable[[np.ndarray], np.ndarray]) -> Anatomy:
    """Return the measures of a body.

    Args:
        body: the body.
        carried: function that interpolates values of the body's vertices to the vertices of its sheet.
    """
    where = skeleton(body)
    place = body.template.astype(np.float64)
    shares = {name: body.weights[:, of].sum(1) for name, of in _parts(body, where).items()}
    arm = _along(body, [where.arm, where.elbow, where.wrist], shares["arms"])
    leg = _along(body, [where.hip, where.knee, where.ankle], shares["legs"])
    joints = body.joints.astype(np.float64)
    hips = float(joints[list(where.hip), 1].mean())
    neck = joints[where.neck[0]]
    skull = place[shares["head"] > 0.5] if (shares["head"] > 0.5).any() else place
    low, high = skull.min(0), skull.max(0)
    on_head = (place - (low + high) / 2) / np.maximum((high - low) / 2, 1e-6)
    on_head[:, 1] = (on_head[:, 1] + 1) / 2

    def length(*chain: tuple[int, int]) -> float:
        ends = [joints[list(pair)] for pair in chain]
        return float(sum(np.linalg.norm(b - a, axis=1).mean() for a, b in pairwise(ends)))

    measures = {
        "place": place, "arms": shares["arms"], "legs": shares["legs"], "head": shares["head"],
        "along_arm": arm, "along_leg": leg, "on_head": on_head,
    }  # fmt: skip
    trunk = float(neck[1]) - hips
    return Anatomy(
        **{name: carried(np.asarray(values, np.float32)) for name, values in measures.items()},
        elbow=length(where.arm, where.elbow),
        wrist=length(where.arm, where.elbow, where.wrist),
        knee=length(where.hip, where.knee),
        ankle=length(where.hip, where.knee, where.ankle),
        hips=hips,
        waist=hips + 0.3 * trunk,
        chest=hips + 0.72 * trunk,
        neck=float(neck[1]),
        neck_place=neck,
    )


def _parts(body: Body, where: Skeleton) -> dict[str, list[int]]:
    """Return the joints of arms, legs and head: the topmost joints of each part and all joints below them."""
    tops = {"arms": where.arm, "legs": where.hip, "head": where.neck[-1:]}
    joints_of_part: dict[str, list[int]] = {name: [] for name in tops}
    for joint in range(len(body.parents)):
        up = joint
        while up >= 0:
            name = next((name for name, roles in tops.items() if up in roles), None)
            if name is not None:
                joints_of_part[name].append(joint)
                break
            up = body.parents[up]
    return joints_of_part


def _along(body: Body, chain: list[tuple[int, int]], share: np.ndarray) -> Float[np.ndarray, "vertex"]:
    """Return each vertex's distance, metres, from the first joint of a limb, measured along the bones of the limb.

    The limb is the left or the right one, depending on the side of the body on which the vertex lies.

    Args:
        body: the body.
        chain: joints of the limb from the trunk outwards, each as the pair (left, right).
        share: share of each vertex's skinning weights that belongs to the limb; where it is 0.5 or less, the distance
            is below 0.
    """
    place, joints = body.template.astype(np.float64), body.joints.astype(np.float64)
    distance = np.full(len(place), AWAY)
    for side in (0, 1):
        first, middle, last = (joints[pair[side]] for pair in chain)
        other = joints[chain[0][1 - side]]
        mine = np.linalg.norm(place - first, axis=1) <= np.linalg.norm(place - other, axis=1)
        upper, lower = (np.linalg.norm(b - a) for a, b in ((first, middle), (middle, last)))
        before = (place - first) @ ((middle - first) / upper)
        after = upper + (place - middle) @ ((last - middle) / lower)
        nearer = _from(place, middle, last) < _from(place, first, middle)
        along = np.where(nearer, np.maximum(after, upper - 0.05), np.minimum(before, upper + 0.05))
        distance = np.where(mine, np.where(share > 0.5, along, np.minimum(along, -0.01)), distance)
    return distance


def _from(place: np.ndarray, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the distance of each point in `place` from the line segment (a bone) from `start` to `end`."""
    along = ((place - start) @ (end - start)) / ((end - start) @ (end - start))
    return np.linalg.norm(place - (start + along.clip(0, 1)[:, None] * (end - start)), axis=1)
