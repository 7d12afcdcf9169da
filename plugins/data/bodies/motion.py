"""Motion files (BVH) of the CMU kind, and the poses of a body that moves as they say."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from framework.errors import DataError
from framework.storage.reading import guarded, read_bytes
from plugins.data.bodies.body import Body
from plugins.data.bodies.poses import Skeleton

SPINE, NECK = ("LowerBack", "Spine", "Spine1"), ("Neck", "Neck1", "Head")
LIMBS = {"clavicle": "Shoulder", "arm": "Arm", "arm_twist": "Arm", "elbow": "ForeArm", "pronate": "ForeArm",
         "wrist": "Hand", "hip": "UpLeg", "knee": "Leg", "ankle": "Foot"}  # fmt: skip
"""Of a body's joints on each side, what turns them in the file, there with Left and Right before."""
BONES = {"arm": "elbow", "elbow": "wrist", "hip": "knee", "knee": "ankle"}
"""Where a limb's joints lead to; the others of a limb hold to the bone before them."""
NAMES = (
    "Hips",
    *SPINE,
    *NECK,
    *(side + name for side in ("Left", "Right") for name in dict.fromkeys(LIMBS.values())),
)
CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
MOST_FRAMES = 1_000_000


@dataclass(frozen=True)
class Motion:
    """Joints that turn; axes: x to the left of who moves, y up, z ahead, where all angles are 0.

    Attributes:
        names, parents: of the joints, each after its parent; -1: none.
        offsets: from the parent where all angles are 0, in the file's own unit.
        turns: of each frame and joint relative to its parent, about axes of the parent.
        seconds: of a frame.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "joint 3"]
    turns: Float[np.ndarray, "frame joint 3 3"]
    seconds: float

    def oriented(self) -> Float[np.ndarray, "frame joint 3 3"]:
        """Rotations of the joints in the world."""
        found = self.turns.copy()
        for joint, parent in enumerate(self.parents):
            if parent >= 0:
                found[:, joint] = found[:, parent] @ found[:, joint]
        return found


def read(file: Path) -> Motion:
    """A BVH file.

    Raises:
        DataError: it is missing or damaged.
    """
    with guarded(file, "a motion file (BVH)"):
        words = iter(read_bytes(file).decode("utf-8").split())
        try:
            names, parents, offsets, channels = _hierarchy(words)
            count, seconds = _header(words)
        except StopIteration:
            raise ValueError("it ends before its motion") from None
        numbers = np.array([float(word) for word in words])
        wanted = (count, sum(map(len, channels)))
        if numbers.size != wanted[0] * wanted[1] or not np.isfinite(numbers).all():
            raise ValueError(
                f"{numbers.size} numbers for {wanted[0]} frames of {wanted[1]}, or one is not finite"
            )
        each = np.split(numbers.reshape(wanted), np.cumsum([len(some) for some in channels])[:-1], axis=1)
        turns = [_turned(some, values) for some, values in zip(channels, each, strict=True)]
        return Motion(tuple(names), tuple(parents), np.array(offsets), np.stack(turns, 1), seconds)


class _Hierarchy(NamedTuple):
    names: list[str]
    parents: list[int]
    offsets: list[list[float]]
    channels: list[list[str]]


def _hierarchy(words: Iterator[str]) -> _Hierarchy:
    """All up to the word MOTION."""
    found, open_joints = _Hierarchy([], [], [], []), list[int]()
    _expect(words, "HIERARCHY")
    for word in words:
        if word in ("ROOT", "JOINT"):
            found.names.append(next(words))
            found.parents.append(open_joints[-1] if open_joints else -1)
            found.channels.append([])
            _expect(words, "{", "OFFSET")
            found.offsets.append([float(next(words)) for _ in range(3)])
            open_joints.append(len(found.names) - 1)
        elif word == "CHANNELS":
            some = [next(words) for _ in range(int(next(words)))]
            if unknown := [name for name in some if name not in CHANNELS]:
                raise ValueError(f"a channel {unknown[0]!r}; wanted some of {', '.join(CHANNELS)}")
            found.channels[open_joints[-1]] = some
        elif word == "End":  # no joint: where the last bone ends
            _expect(words, "Site", "{", "OFFSET")
            _ = [float(next(words)) for _ in range(3)]
            _expect(words, "}")
        elif word == "}":
            open_joints.pop()
        elif word == "MOTION" and found.names and not open_joints:
            return found
        else:
            raise ValueError(f"the word {word!r} in its hierarchy")
    raise StopIteration


def _header(words: Iterator[str]) -> tuple[int, float]:
    _expect(words, "Frames:")
    count = int(next(words))
    _expect(words, "Frame", "Time:")
    seconds = float(next(words))
    if not 0 < count <= MOST_FRAMES or not 0 < seconds < 1e3:
        raise ValueError(f"{count} frames of {seconds} s")
    return count, seconds


def _expect(words: Iterator[str], *wanted: str) -> None:
    for word in wanted:
        if (found := next(words, "its end")) != word:
            raise ValueError(f"{found!r} where {word!r} has to stand")


def _turned(channels: Sequence[str], values: np.ndarray) -> Float[np.ndarray, "frame 3 3"]:
    """Rotations in the order of their channels, the last nearest to what is turned."""
    axes = [(name[0], column) for column, name in enumerate(channels) if name.endswith("rotation")]
    if not axes:
        return np.tile(np.eye(3), (len(values), 1, 1))
    order = "".join(axis for axis, _ in axes)
    degrees = values[:, [column for _, column in axes]]
    return Rotation.from_euler(
        order, degrees, degrees=True
    ).as_matrix()  # capitals: each about the axes turned before


def poses_of(
    motion: Motion, body: Body, where: Skeleton, frames: Sequence[int]
) -> Float[np.ndarray, "pose joint 3"]:
    """Joint rotations for plugins.data.bodies.body, axis times angle in radians, of these frames.

    Bones point where those of the file do: a limb that rests in another direction than the file's is first turned there
    by the smallest rotation. The body stays where it is.

    Raises:
        DataError: the file lacks a joint.
    """
    missing = [name for name in NAMES if name not in motion.names]
    if missing:
        raise DataError(
            f"the motion has no joint {missing[0]!r}; wanted {', '.join(NAMES)}, as those of CMU have."
        )
    place = {name: motion.names.index(name) for name in NAMES}
    oriented = motion.oriented()[list(frames)]
    joints = body.joints.astype(np.float64)
    world = np.tile(np.eye(3), (len(oriented), len(body.parents), 1, 1))
    moved = np.zeros(len(body.parents), bool)

    def hold(joint: int, name: str, rest: np.ndarray) -> None:
        world[:, joint] = oriented[:, place[name]] @ rest
        moved[joint] = True

    hold(where.root, "Hips", np.eye(3))
    for chain, names in ((where.spine, SPINE), (where.neck, NECK)):
        for number, joint in enumerate(chain):
            last = max(len(chain) - 1, 1)
            hold(joint, names[round(number * (len(names) - 1) / last)], np.eye(3))
    for side, word in enumerate(("Left", "Right")):
        rest = np.eye(3)
        for role, name in LIMBS.items():
            joint = getattr(where, role)[side]
            if role in ("clavicle", "hip"):
                rest = np.eye(3)
            if role in BONES:
                ours = joints[getattr(where, BONES[role])[side]] - joints[joint]
                rest = _between(ours, motion.offsets[place[word + LIMBS[BONES[role]]]])
            hold(joint, word + name, rest)
    found = np.zeros((len(oriented), len(body.parents), 3))
    for joint in _from_the_root(body.parents):
        parent = body.parents[joint]
        above = world[:, parent] if parent >= 0 else np.eye(3)
        if not moved[joint]:
            world[:, joint] = above
        found[:, joint] = Rotation.from_matrix(np.swapaxes(np.broadcast_to(above, world[:, joint].shape), -1, -2)
                                               @ world[:, joint]).as_rotvec()  # fmt: skip
    return found


def _from_the_root(parents: Sequence[int]) -> list[int]:
    """Joints, each after its parent."""
    order = [joint for joint, parent in enumerate(parents) if parent < 0]
    for joint in order:
        order += [child for child, parent in enumerate(parents) if parent == joint]
    return order


def _between(one: np.ndarray, other: np.ndarray) -> Float[np.ndarray, "3 3"]:
    """The smallest rotation that takes one direction to another."""
    a, b = one / np.linalg.norm(one), other / np.linalg.norm(other)
    axis, cosine = np.cross(a, b), float(a @ b)
    sine = float(np.linalg.norm(axis))
    return Rotation.from_rotvec(axis / max(sine, 1e-300) * np.arctan2(sine, cosine)).as_matrix()
