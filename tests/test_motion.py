import os
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from framework.bodies import motion
from framework.bodies.body import BodyModel
from framework.bodies.people import load_body
from framework.bodies.poses import skeleton
from framework.errors import DataError
from framework.testing.bodies import DOLL
from framework.testing.data_folders import damage
from framework.testing.rows import DAMAGES

TREE = {
    "Hips": {
        "Spine": {
            "Spine1": {
                "Neck": {"Head": {}},
                **{
                    f"{side}Shoulder": {f"{side}Arm": {f"{side}ForeArm": {f"{side}Hand": {}}}}
                    for side in ("Left", "Right")
                },
            }
        },
        **{f"{side}UpLeg": {f"{side}Leg": {f"{side}Foot": {}}} for side in ("Left", "Right")},
    }
}
"""Joints of a file, as a tree."""
ORDERS = ("ZYX", "XYZ", "YZX")


def written(file, frames=3, seed=0, prefix=""):
    """Write a BVH file of random bones and angles, and return its offsets, channel orders and angles by joint name."""
    random = np.random.default_rng(seed)
    lines, offsets, orders = ["HIERARCHY"], {}, {}

    def joint(name, below, kind):
        offsets[name], orders[name] = random.normal(size=3).round(6), ORDERS[len(orders) % 3]
        axes = " ".join(f"{axis}rotation" for axis in orders[name])
        channels = f"6 Xposition Yposition Zposition {axes}" if kind == "ROOT" else f"3 {axes}"
        lines.extend(
            [
                f"{kind} {prefix}{name}",
                "{",
                f"OFFSET {' '.join(map(str, offsets[name]))}",
                f"CHANNELS {channels}",
            ]
        )
        for child, rest in below.items():
            joint(child, rest, "JOINT")
        lines.extend([] if below else ["End Site", "{", "OFFSET 0 1 0", "}"])
        lines.append("}")

    joint("Hips", TREE["Hips"], "ROOT")
    angles = random.uniform(-180, 180, (frames, len(orders), 3)).round(4)
    places = random.normal(size=(frames, 3)).round(4)
    rows = [
        " ".join(map(str, [*place, *turned.ravel()])) for place, turned in zip(places, angles, strict=True)
    ]
    lines += ["MOTION", f"Frames: {frames}", "Frame Time: .01", *rows]
    file.write_text("\n".join(lines) + "\n")
    return offsets, orders, {name: angles[:, place] for place, name in enumerate(orders)}


def directions(offsets, orders, angles, frame):
    """Return unit vectors of the arms' and legs' bones, by products of matrices about single axes from the root on."""
    found = {}

    def walk(name, below, above):
        turn = above
        for axis, degrees in zip(orders[name], angles[name][frame], strict=True):
            turn = turn @ Rotation.from_rotvec(np.radians(degrees) * np.eye(3)["XYZ".index(axis)]).as_matrix()
        for child, rest in below.items():
            bone = turn @ offsets[child]
            found[name] = bone / np.linalg.norm(bone)
            walk(child, rest, turn)

    walk("Hips", TREE["Hips"], np.eye(3))
    return found


ROLES = {
    "Arm": ("arm", "elbow"),
    "ForeArm": ("elbow", "wrist"),
    "UpLeg": ("hip", "knee"),
    "Leg": ("knee", "ankle"),
}


@pytest.mark.parametrize("file", [None, DOLL["body"]], ids=["the default body", "the SMPL family"])
def test_bones_point_where_those_of_the_file_do(file, tmp_path):
    made, _ = load_body(file)
    where, model = skeleton(made), BodyModel(made).double()
    offsets, orders, angles = written(tmp_path / "a.bvh", prefix="someone:")
    found = motion.transfer_motion(made, motion.read(tmp_path / "a.bvh"), [2, 0])
    joints = model.posed_joints(torch.zeros(2, 1).double(), torch.from_numpy(found)).numpy()
    for row, frame in enumerate((2, 0)):
        wanted = directions(offsets, orders, angles, frame)
        for number, side in enumerate(("Left", "Right")):
            for name, (start, end) in ROLES.items():
                bone = joints[row, getattr(where, end)[number]] - joints[row, getattr(where, start)[number]]
                np.testing.assert_allclose(bone / np.linalg.norm(bone), wanted[side + name], atol=1e-6)
    # the head rotates as the file's, for any number of joints that share the rotation
    turned, at = Rotation.identity(), where.neck[-1]
    while at >= 0:
        turned, at = Rotation.from_rotvec(found[1, at]) * turned, made.parents[at]
    theirs = Rotation.identity()
    for name in ("Hips", "Spine", "Spine1", "Neck", "Head"):
        theirs = theirs * Rotation.from_euler(orders[name], angles[name][0], degrees=True)
    assert (turned.inv() * theirs).magnitude() < 1e-9


def test_where_nothing_turns_limbs_point_along_the_offsets_and_the_trunk_is_upright(tmp_path):
    made, _ = load_body(DOLL["body"])
    written(tmp_path / "a.bvh")
    still = motion.read(tmp_path / "a.bvh")
    still = still._replace(rotations=np.broadcast_to(np.eye(3), still.rotations.shape))
    pose, where = motion.transfer_motion(made, still, [0])[0], skeleton(made)
    assert not pose[[where.root, *where.spine, *where.neck, *where.clavicle]].any()


@pytest.mark.parametrize("one", [(1, 0, 0), (0, -2, 0), (0.3, -0.4, 0.1)])
def test_the_smallest_turn_also_turns_a_bone_round(one):
    for other in (one, [-number for number in one], (0, 0, 1), (1, 1e-9, 0)):
        found = motion._turn(np.array(one, float), np.array(other, float))
        other = np.array(other, float)
        np.testing.assert_allclose(
            found.apply(np.array(one) / np.linalg.norm(one)), other / np.linalg.norm(other), atol=1e-9
        )


WRONG = {
    "no bvh": (lambda text: "HIERARCHY\n", "the word MOTION after the joints"),
    "two roots": (lambda text: text.replace("JOINT Spine\n", "ROOT Spine\n"), "a single ROOT"),
    "not closed": (lambda text: text.replace("}\nMOTION", "MOTION"), "lacks its closing brace"),
    "a word": (lambda text: text.replace("OFFSET", "OFFSTE", 1), "OFFSTE"),
    "too few numbers": (lambda text: text.rpartition(" ")[0], "channels"),
    "not finite": (lambda text: text.rpartition(" ")[0] + " nan", r"line \d+: nan is not a finite number"),
    "no frames": (lambda text: re.sub(r"Frames: \d+", "Frames: 0", text), "states 0 frames, expected 1 to"),
}


@pytest.mark.parametrize("spoil, words", WRONG.values(), ids=WRONG)
def test_a_wrong_file_is_told(spoil, words, tmp_path):
    file = tmp_path / "a.bvh"
    written(file)
    file.write_text(spoil(file.read_text()))
    with pytest.raises(DataError, match=rf"a\.bvh.*{words}"):
        motion.read(file)


def test_other_damage_and_other_skeletons_are_told(tmp_path):
    for kind in DAMAGES:
        file = tmp_path / f"{kind}.bvh"
        written(file)
        damage(file, kind)
        with pytest.raises(DataError, match=f"{kind}.bvh"):
            motion.read(file)
    written(tmp_path / "a.bvh")
    found = motion.read(tmp_path / "a.bvh")
    other = found._replace(names=tuple(name.replace("LeftLeg", "Tail") for name in found.names))
    with pytest.raises(DataError, match="no joint called leftleg or leftlowleg; expected one"):
        motion.transfer_motion(load_body(DOLL["body"])[0], other, [0])


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_a_captured_walk_swings_arms_and_legs_as_the_file_does():
    file = Path(os.environ["REAL_DATA_ROOT"]) / "bodies/cmu_12_01_walk.bvh"
    made, _ = load_body(None)
    where, moving = skeleton(made), motion.read(file)
    frames = list(range(100, 500, 4))
    pose = torch.from_numpy(motion.transfer_motion(made, moving, frames))
    joints = BodyModel(made).double().posed_joints(torch.zeros(len(frames), 1).double(), pose).numpy()
    for role, name in ((where.wrist, "Hand"), (where.ankle, "Foot")):
        ours = (joints[:, role[0]] - joints[:, role[1]])[:, 2]
        # lead of the left side over the right in the file's own skeleton
        theirs = [
            placed(moving, frame, f"Left{name}")[2] - placed(moving, frame, f"Right{name}")[2]
            for frame in frames
        ]
        assert np.corrcoef(ours, theirs)[0, 1] > 0.99 and np.ptp(ours) > 0.4
    up = joints[:, where.root, 1]
    assert (joints[:, where.neck[-1], 1] - up > 0.5).all()
    assert (up[:, None] - joints[:, list(where.ankle), 1] > 0.4).all()


def placed(moving, frame, name):
    """Return the position of a joint of the file, computed from the joint up to the root."""
    joint, place = moving.names.index(name), np.zeros(3)
    while joint >= 0:
        place = moving.offsets[joint] + moving.rotations[frame, joint] @ place
        joint = moving.parents[joint]
    return place
