"""Motions from BVH files (Biovision hierarchy, a format of the CMU motion-capture database) as poses of any body.

A body's bones take the directions of the file's bones. The translation of the person is not read, and neither are
fingers, toes and joints that only some skeletons have.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from framework.bodies.body import Body
from framework.bodies.poses import skeleton
from framework.errors import DataError, quote, shorten
from framework.storage.limits import MOST_FRAMES as LONGEST
from framework.storage.reading import read_bytes, translate_errors
from framework.storage.text import decode, line_of_word, require_numbers_in, words_of

BONES = {
    "chest": ("spine2", "spine1", "chest"),
    "head": ("head",),
    "clavicle": ("{side}shoulder", "{side}collar"),
    "arm": ("{side}arm", "{side}uparm"),
    "elbow": ("{side}forearm", "{side}lowarm"),
    "wrist": ("{side}hand",),
    "hip": ("{side}upleg", "{side}hip"),
    "knee": ("{side}leg", "{side}lowleg"),
    "ankle": ("{side}foot",),
}
"""Names that BVH files use for the joint of each role of framework.bodies.poses.Skeleton.

The names are in lower case, without underscores and without a prefix that ends with a colon. `{side}` stands for the
side of the body. If a file has joints with several names of one role, the first of these names in the tuple is used.
"""
ENDS = {"arm": "elbow", "elbow": "wrist", "hip": "knee", "knee": "ankle"}
"""Bones whose directions are taken from the file, as joint at the beginning → joint at the end of the bone.

All other joints rotate as in the file.
"""
CHANNELS = {f"{axis}{kind}" for axis in "XYZ" for kind in ("position", "rotation")}
SLOWEST = 1_000
"""Exclusive upper limit of the duration of a frame, seconds."""


class Motion(NamedTuple):
    """Content of a BVH file.

    Attributes:
        names, parents: name of each joint, and index of its parent joint; -1 for the root.
        offsets: position of each joint relative to its parent if no joint rotates, in the file's unit.
        rotations: rotation of each joint relative to its parent, in each frame.
        seconds: duration of a frame.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "joint 3"]
    rotations: Float[np.ndarray, "frame joint 3 3"]
    seconds: float


def read(file: Path) -> Motion:
    """Read a BVH file, angles in degrees, y up.

    Raises:
        DataError: the file cannot be read, or is not a BVH file.
    """
    with translate_errors(
        file, "a motion in BVH format", missing="expected a motion in BVH format. Correct the path."
    ):
        text = decode(read_bytes(file))
        head, separator, rest = text.partition("MOTION")
        above = words_of(head)
        if not separator or above[:1] != ["HIERARCHY"]:
            raise ValueError(
                "the file lacks the word HIERARCHY at its beginning, or the word MOTION after the joints"
            )
        names, parents, offsets, channels = _hierarchy(above[1:], text)
        words = words_of(rest)
        if words[:1] != ["Frames:"] or words[2:4] != ["Frame", "Time:"] or len(words) < 5:
            raise ValueError(
                "the part after MOTION does not begin with `Frames:` and `Frame Time:`, each followed by a number"
            )
        before = len(above) + 1
        frames = _whole(words[1], text, before + 1)
        seconds, *values_of_frames = require_numbers_in(words[4:], text, before + 4)
        numbers = np.array(values_of_frames)
        if not 0 < seconds < SLOWEST:
            raise ValueError(f"a frame lasts {seconds:g} s, expected more than 0 and less than {SLOWEST:g} s")
        columns = sum(map(len, channels))
        if not 1 <= frames <= LONGEST:
            raise ValueError(f"the file states {frames} frames, expected 1 to {LONGEST}")
        if numbers.size != frames * columns:
            raise ValueError(
                f"the file has {numbers.size} numbers after the frame time, expected {frames * columns} for {frames} "
                f"frames of {columns} channels"
            )
        if not np.isfinite(numbers).all():
            bad = int(np.flatnonzero(~np.isfinite(numbers))[0])
            line = line_of_word(text, before + 5 + bad)
            raise ValueError(f"line {line}: {words[5 + bad]} is not a finite number")
        values = numbers.reshape(frames, columns)
        turns, first = np.empty((frames, len(names), 3, 3)), 0
        for joint, kinds in enumerate(channels):
            turning = [place for place, kind in enumerate(kinds) if kind.endswith("rotation")]
            axes = "".join(kinds[place][0] for place in turning).upper()
            turns[:, joint] = np.eye(3)
            if axes:  # capitals denote intrinsic rotations: the first channel is the outermost
                turns[:, joint] = Rotation.from_euler(
                    axes, values[:, [first + place for place in turning]], degrees=True
                ).as_matrix()
            first += len(kinds)
        return Motion(tuple(names), tuple(parents), np.array(offsets), turns, seconds)


def _whole(word: str, text: str, place: int) -> int:
    if not word.isascii() or not word.isdigit():
        raise ValueError(f"line {line_of_word(text, place)}: expected a whole number, got {quote(word)}")
    return int(word)


def _hierarchy(
    words: list[str], text: str
) -> tuple[list[str], list[int], list[list[float]], list[list[str]]]:
    """Return names, parents, offsets and channels of the joints, without the end sites of the last bones.

    Args:
        words: words of the part of the file that begins with "HIERARCHY", without this word.
        text: content of the file, for messages.
    """
    names, parents, offsets, channels = [], [], [], []
    above, place = [-1], 0
    while place < len(words):
        word = words[place]
        if word in ("OFFSET", "CHANNELS", "}", "End") and len(above) == 1:
            raise ValueError(
                f"the word {word} occurs outside of all joints; expected the word between the braces of a joint"
            )
        if word in ("ROOT", "JOINT"):
            if (word == "ROOT") != (len(above) == 1) or (word == "ROOT" and names):
                raise ValueError(
                    f"{word} {shorten(words[place + 1])} occurs at a place where no such joint can begin; expected a "
                    "single ROOT, and each JOINT within another joint"
                )
            parents.append(above[-1])
            above.append(len(names))
            names.append(words[place + 1])
            offsets.append([0.0] * 3)
            channels.append([])
            place += 3
        elif word == "End":
            place = words.index("}", place) + 1
        elif word == "OFFSET":
            offsets[above[-1]] = require_numbers_in(words[place + 1 : place + 4], text, place + 2)
            if len(offsets[above[-1]]) != 3 or not np.isfinite(offsets[above[-1]]).all():
                raise ValueError(
                    f"the word OFFSET of joint {shorten(names[above[-1]])} is not followed by three finite numbers"
                )
            place += 4
        elif word == "CHANNELS":
            count = _whole(words[place + 1], text, place + 2)
            kinds = words[place + 2 : place + 2 + count]
            if len(kinds) != count or not set(kinds) <= CHANNELS or len(set(kinds)) < count:
                raise ValueError(
                    f"CHANNELS of joint {shorten(names[above[-1]])}: expected the number of channels, and then as "
                    f"many names out of {', '.join(sorted(CHANNELS))}"
                )
            channels[above[-1]] = kinds
            place += 2 + count
        elif word == "}":
            above.pop()
            place += 1
        else:
            line = line_of_word(text, place + 1)
            raise ValueError(
                f"line {line}: got {shorten(word)}, but the description of a joint continues only with OFFSET, "
                "CHANNELS, JOINT, End Site or a brace"
            )
    if len(above) != 1 or not names:
        raise ValueError("the file has no joints, or a joint lacks its closing brace")
    return names, parents, offsets, channels


def transfer_motion(body: Body, motion: Motion, frames: list[int]) -> Float[np.ndarray, "pose joint 3"]:
    """Return the joint rotations (axis times angle, radians) that give a body the poses of some frames of a motion.

    The body's upper arms, forearms, thighs and shanks take the directions of the motion's bones, and all other joints
    rotate as in the file. A bend of the back or of the neck is shared equally by the body's joints there. In the file's
    own rest pose the trunk is taken to be upright and to face z.

    Raises:
        DataError: the motion has no joint for one of the roles in `BONES`.
    """
    where, roles = skeleton(body), _roles(motion)
    whole: list[Rotation] = []  # global rotation of each joint of the file, from its rest pose
    for joint, parent in enumerate(motion.parents):
        local = Rotation.from_matrix(motion.rotations[frames, joint])
        whole.append(local if parent < 0 else whole[parent] * local)
    global_rotations = {where.root: whole[0]}
    along = (("spine", where.spine, whole[0], "chest"), ("neck", where.neck, whole[roles["chest"]], "head"))
    for _, joints, below, end in along:
        bend = (below.inv() * whole[roles[end]]).as_rotvec() / len(joints)
        for number, joint in enumerate(joints):
            global_rotations[joint] = below * Rotation.from_rotvec(bend * (number + 1))
    places = _places(motion)
    for number, side in enumerate(("left", "right")):
        direction = Rotation.identity()
        for role in ("clavicle", "arm", "elbow", "wrist", "hip", "knee", "ankle"):
            joint, theirs = getattr(where, role)[number], roles[f"{side} {role}"]
            if role in ("clavicle", "hip"):
                direction = Rotation.identity()
            if role in ENDS:  # the smallest rotation from our bone's rest direction to the file's
                end = getattr(where, ENDS[role])[number]
                ours = (body.joints[end] - body.joints[joint]).astype(np.float64)
                direction = _turn(ours, places[roles[f"{side} {ENDS[role]}"]] - places[theirs])
            global_rotations[joint] = whole[theirs] * direction
    pose = np.zeros((len(frames), len(body.parents), 3))
    for joint in _downwards(body.parents):
        parent = body.parents[joint]
        above = global_rotations[parent] if parent >= 0 else Rotation.identity(len(frames))
        pose[:, joint] = (above.inv() * global_rotations.setdefault(joint, above)).as_rotvec()
    return pose


def _roles(motion: Motion) -> dict[str, int]:
    names = [name.rpartition(":")[2].replace("_", "").lower() for name in motion.names]
    joint_of_role = {}
    for role, wanted in BONES.items():
        for side in ("left", "right") if "{" in wanted[0] else ("",):
            called = [name.format(side=side) for name in wanted]
            matches = [names.index(name) for name in called if name in names]
            if not matches:
                raise DataError(
                    f"The motion has no joint called {' or '.join(called)}; expected one. The joints are "
                    f"{shorten(', '.join(motion.names))}. Rename a joint."
                )
            joint_of_role[f"{side} {role}".strip()] = matches[0]
    return joint_of_role


def _places(motion: Motion) -> Float[np.ndarray, "joint 3"]:
    """Return the positions that the joints have if no joint rotates."""
    positions = motion.offsets.copy()
    for joint, parent in enumerate(motion.parents):
        positions[joint] += positions[parent] if parent >= 0 else 0
    return positions


def _turn(start: np.ndarray, end: np.ndarray) -> Rotation:
    """Return the rotation by the smallest angle that maps the direction `start` to the direction `end`."""
    axis = np.cross(start, end)
    angle = np.arctan2(np.linalg.norm(axis), start @ end)
    if np.linalg.norm(axis) < 1e-9 * np.linalg.norm(start) * np.linalg.norm(end):  # parallel directions
        axis = np.cross(start, np.eye(3)[np.abs(start).argmin()])
    return Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))


def _downwards(parents: tuple[int, ...]) -> list[int]:
    """Return all joints, ordered so that each joint follows its parent."""
    ordered_joints = [joint for joint, parent in enumerate(parents) if parent < 0]
    for joint in ordered_joints:
        ordered_joints += [child for child, parent in enumerate(parents) if parent == joint]
    return ordered_joints
