"""Random poses within plausible limits, and the joints of a body that each movement rotates.

Movements are angles in degrees that mean the same for every body in any rest pose: an arm raised by 90° is horizontal,
an elbow bent by 0° is straight. The x axis points to the body's left, y up and z to the front.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numpy.random import Generator
from scipy.spatial.transform import Rotation

from framework.bodies.body import Body
from framework.errors import DataError

Degrees = float | int
Range = tuple[Degrees, Degrees, Degrees, Degrees]
"""Mean, standard deviation, smallest and largest value of a movement."""
Kinds = dict[str, tuple[float, dict[str, tuple[Degrees, Degrees]]]]
"""Kinds of poses by name, each as a pair: its share among random poses, and the movements that characterise it.

Each of these movements has a mean and a standard deviation, which replace those in `SIDED`.
"""
CENTRAL: dict[str, Range] = {
    "pitch": (0, 4, -15, 15),  # pitch, yaw, roll: the whole body about x, y and z
    "yaw": (0, 12, -40, 40),
    "roll": (0, 3, -12, 12),
    "lean": (2, 6, -20, 50),  # lean, bend, turn: the spine; lean is forwards
    "bend": (0, 5, -22, 22),
    "turn": (0, 8, -35, 35),
    "nod": (0, 8, -30, 35),  # nod, tilt, look: the head
    "tilt": (0, 5, -20, 20),
    "look": (0, 14, -60, 60),
}
SIDED: dict[str, Range] = {
    "shrug": (0, 4, -8, 18),
    "raise": (45, 8, 4, 165),  # the arm sidewards, from hanging
    "forward": (0, 6, -30, 100),  # a raised arm towards the front
    "swing": (0, 10, -60, 40),  # the arm about x; below 0 to the front
    "twist": (0, 12, -60, 60),
    "elbow": (15, 10, 0, 140),
    "pronate": (0, 20, -80, 80),
    "wrist": (0, 8, -45, 45),
    "hip": (0, 5, -25, 100),  # the thigh forwards
    "spread": (4, 4, -8, 45),  # the thigh sidewards
    "hip_turn": (0, 6, -30, 35),
    "knee": (3, 4, 0, 130),
    "ankle": (0, 5, -35, 25),
}
ARMS: Kinds = {
    "hanging": (0.25, {"raise": (12, 6), "swing": (0, 14), "elbow": (18, 12)}),
    "slanting": (0.15, {}),
    "level": (0.15, {"raise": (90, 7), "swing": (0, 4), "elbow": (6, 6), "pronate": (0, 35)}),
    "up": (0.07, {"raise": (145, 14), "elbow": (25, 18), "twist": (0, 20)}),
    "ahead": (0.08, {"raise": (80, 12), "forward": (70, 18), "elbow": (30, 25)}),
    "bent": (0.10, {"raise": (30, 14), "swing": (-20, 15), "elbow": (90, 25), "twist": (0, 25)}),
    "any": (
        0.20,
        {"raise": (75, 40), "forward": (25, 35), "swing": (-10, 18), "elbow": (45, 38), "twist": (0, 25)},
    ),
}
LEGS: Kinds = {
    "standing": (0.60, {}),
    "stepping": (0.22, {"hip": (10, 22), "knee": (18, 14), "spread": (4, 5)}),
    "wide": (0.10, {"spread": (20, 8), "hip_turn": (5, 8)}),
    "lifted": (0.08, {"hip": (50, 28), "knee": (55, 30), "spread": (8, 8)}),
}
ALIKE = 0.6
"""Share of poses in which the right arm takes the kind of the left arm; both legs always have the same kind."""
TAIL, WIDER = 0.1, 1.8
"""Share of poses that are drawn with larger standard deviations, and the factor on the deviations (thesis §6.5.2)."""
MOVEMENTS = (*CENTRAL, *(f"{side} {name}" for side in ("left", "right") for name in SIDED))


@dataclass(frozen=True)
class Skeleton:
    """Indices of a body's joints by their roles: each field holds the joints that movements of this role rotate.

    For example, the movement "left elbow" rotates `elbow[0]`. A field with two joints holds (left, right). The joints
    of `spine`, and those of `neck`, share a rotation equally.
    """

    root: int
    spine: tuple[int, ...]
    neck: tuple[int, ...]
    clavicle: tuple[int, int]
    arm: tuple[int, int]
    arm_twist: tuple[int, int]
    elbow: tuple[int, int]
    pronate: tuple[int, int]
    wrist: tuple[int, int]
    hip: tuple[int, int]
    knee: tuple[int, int]
    ankle: tuple[int, int]


NAMED = {
    "root": ("root",),
    "spine": ("spine05", "spine04", "spine03", "spine02", "spine01"),
    "neck": ("neck01", "neck02", "neck03", "head"),
    "clavicle": ("clavicle.L", "clavicle.R"),
    "arm": ("upperarm01.L", "upperarm01.R"),
    "arm_twist": ("upperarm02.L", "upperarm02.R"),
    "elbow": ("lowerarm01.L", "lowerarm01.R"),
    "pronate": ("lowerarm02.L", "lowerarm02.R"),
    "wrist": ("wrist.L", "wrist.R"),
    "hip": ("upperleg01.L", "upperleg01.R"),
    "knee": ("lowerleg01.L", "lowerleg01.R"),
    "ankle": ("foot.L", "foot.R"),
}
"""Names of the default body's joints, for each field of `Skeleton`."""
JOINTS = tuple(name for names in NAMED.values() for name in names)
ORDERED = Skeleton(
    root=0,
    spine=(3, 6, 9),
    neck=(12, 15),
    clavicle=(13, 14),
    arm=(16, 17),
    arm_twist=(16, 17),
    elbow=(18, 19),
    pronate=(20, 21),
    wrist=(20, 21),
    hip=(1, 2),
    knee=(4, 5),
    ankle=(7, 8),
)
"""Indices of the joints of the SMPL family, whose files have no names (Loper et al. 2015; Pavlakos et al. 2019).

Only the first 22 joints are used.
"""


def skeleton(body: Body) -> Skeleton:
    """Return the joints of a body by their roles.

    The joints are found by name in the default body, and by their order if they have no names (the SMPL family).

    Raises:
        DataError: the joints have no names and are fewer than 22, or a joint of the default body is missing.
    """
    if not body.names:
        if len(body.parents) < 22:
            raise DataError(
                f"{body.source} has {len(body.parents)} joints; expected 22 at least, in the order of the SMPL family. "
                "Choose another file, or leave out data.body for the default body."
            )
        return ORDERED
    missing = [name for name in JOINTS if name not in body.names]
    if missing:
        raise DataError(
            f"{body.source} has no joint {missing[0]!r}; expected the joints {', '.join(JOINTS)}. Choose another file."
        )
    places = {role: tuple(body.names.index(name) for name in names) for role, names in NAMED.items()}
    return Skeleton(root=places.pop("root")[0], **places)  # pyright: ignore[reportArgumentType]


def draw(count: int, random: Generator) -> Float[np.ndarray, "pose movement"]:
    """Return movements of random poses, degrees, in the order of MOVEMENTS.

    A movement has the same sign for the left and the right side, so equal values give a symmetric pose.
    """
    wide = np.where(random.random(count) < TAIL, WIDER, 1.0)
    left_arm = _choice(ARMS, count, random)
    right_arm = np.where(random.random(count) < ALIKE, left_arm, _choice(ARMS, count, random))
    legs = _choice(LEGS, count, random)
    columns = [_limited(limits, *limits[:2], wide, random) for limits in CENTRAL.values()]
    for arm in (left_arm, right_arm):
        for name, limits in SIDED.items():
            mean, spread = np.full(count, limits[0]), np.full(count, limits[1])
            for chosen, kinds in ((arm, ARMS), (legs, LEGS)):
                for number, (_, changes) in enumerate(kinds.values()):
                    if name in changes:
                        chosen_rows = chosen == number
                        mean[chosen_rows], spread[chosen_rows] = changes[name]
            columns.append(_limited(limits, mean, spread, wide, random))
    return np.stack(columns, 1)


def _choice(kinds: Kinds, count: int, random: Generator) -> Int[np.ndarray, "pose"]:
    return random.choice(len(kinds), count, p=[share for share, _ in kinds.values()])


def _limited(
    limits: Range,
    mean: Degrees | np.ndarray,
    spread: Degrees | np.ndarray,
    wide: np.ndarray,
    random: Generator,
) -> Float[np.ndarray, "pose"]:
    """Return random normal numbers between the limits.

    A number beyond a limit is mirrored at this limit, so that no numbers accumulate there. `wide` is a factor on the
    standard deviation `spread` for each pose.
    """
    _, _, least, most = limits
    values = random.normal(mean, spread * wide)
    folded = np.where(values < least, 2 * least - values, np.where(values > most, 2 * most - values, values))
    return folded.clip(least, most)


def rotations(
    body: Body, where: Skeleton, movements: Float[np.ndarray, "pose movement"]
) -> Float[np.ndarray, "pose joint 3"]:
    """Return the joint rotations that put a body into the given poses, each as axis times angle in radians.

    Args:
        body: the body, in any rest pose; the returned rotations lead from the rest pose to the given poses.
        where: the joints that each movement rotates.
        movements: angle of each movement in each pose, degrees, in the order of MOVEMENTS ("left elbow", "lean").
    """
    angle = dict(zip(MOVEMENTS, np.radians(movements).T, strict=True))
    count, joints = len(movements), body.joints.astype(np.float64)
    joint_rotations = [Rotation.identity(count)] * len(body.parents)

    def turn(places: Sequence[int], *about: tuple[Sequence[float] | np.ndarray, np.ndarray]) -> None:
        """Rotate the joints `places`, which share each rotation equally.

        `about` are pairs (axis, angles in radians). The last pair is applied first. Its rotation does not change the
        axes of the other pairs.
        """
        for place in places:
            for axis, radians in reversed(about):
                joint_rotations[place] = _about(axis, radians / len(places)) * joint_rotations[place]

    x, y, z = np.eye(3)
    turn([where.root], (y, angle["yaw"]), (x, angle["pitch"]), (z, angle["roll"]))
    turn(where.spine, (y, angle["turn"]), (x, angle["lean"]), (z, angle["bend"]))
    turn(where.neck, (y, angle["look"]), (x, angle["nod"]), (z, angle["tilt"]))
    for side, sign in enumerate((1, -1)):
        of = {name: angle[f"{('left', 'right')[side]} {name}"] for name in SIDED}
        shoulder, elbow, wrist = (joints[role[side]] for role in (where.arm, where.elbow, where.wrist))
        upper, fore = _unit(elbow - shoulder), _unit(wrist - elbow)
        raised = np.arctan2(sign * upper[0], -upper[1])  # angle from hanging in the rest pose
        bent = np.arccos(np.clip(upper @ fore, -1, 1))
        # rotation about this axis bends a forearm forwards; for an arm straight in the rest pose, forwards is z
        hinge = np.cross(upper, fore) if bent > 0.1 else np.cross(upper, z)
        turn([where.clavicle[side]], (z, sign * of["shrug"]))
        turn([where.arm_twist[side]], (upper, sign * of["twist"]))
        turn(
            [where.arm[side]],
            (x, of["swing"]),
            (y, -sign * of["forward"]),
            (z, sign * (of["raise"] - raised)),
        )
        turn([where.elbow[side]], (_unit(hinge), of["elbow"] - bent))
        turn([where.pronate[side]], (fore, sign * of["pronate"]))
        turn([where.wrist[side]], (z, sign * of["wrist"]))
        thigh = _unit(joints[where.knee[side]] - joints[where.hip[side]])
        spread_angle = np.arctan2(sign * thigh[0], -thigh[1])
        turn(
            [where.hip[side]],
            (x, -of["hip"]),
            (z, sign * (of["spread"] - spread_angle)),
            (y, sign * of["hip_turn"]),
        )
        turn([where.knee[side]], (x, of["knee"]))
        turn([where.ankle[side]], (x, of["ankle"]))
    return np.stack([rotation.as_rotvec() for rotation in joint_rotations], 1)


def _about(axis: Sequence[float] | np.ndarray, radians: np.ndarray) -> Rotation:
    return Rotation.from_rotvec(np.asarray(axis) * radians[:, None])


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
