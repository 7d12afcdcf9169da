import math
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from framework.bodies import body_files, poses
from framework.bodies.body import Body, BodyModel
from framework.errors import DataError
from framework.testing.bodies import JOINTS, write_body_file


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return Path(write_body_file(tmp_path_factory.mktemp("body"))["body"])


def angles(**movements):
    named = {
        name.replace("_", " ", 1) if name.split("_")[0] in ("left", "right") else name: value
        for name, value in movements.items()
    }
    return np.array([[named.get(name, rest(name)) for name in poses.MOVEMENTS]], float)


def rest(name):
    """Return the value of a movement that leaves a T-pose unchanged."""
    return 90.0 if name.endswith("raise") else 0.0


def placed(file, **movements):
    body = body_files.read(file)
    pose = poses.rotations(body, poses.skeleton(body), angles(**movements))
    model = BodyModel(body)
    return model.posed_joints(torch.zeros(1, 0, dtype=torch.float64), torch.from_numpy(pose))[0].numpy()


def test_movements_take_joints_where_their_names_say(file):
    shoulder, elbow, wrist = 16, 18, 20
    np.testing.assert_allclose(placed(file), JOINTS, atol=1e-12)
    down = placed(file, left_raise=0)
    np.testing.assert_allclose(down[wrist], JOINTS[shoulder] + [0, -0.5, 0], atol=1e-12)
    np.testing.assert_allclose(down[21], JOINTS[21], atol=1e-12)  # the other arm stays
    up = placed(file, right_raise=160)
    wanted = [-math.sin(math.radians(160)), -math.cos(math.radians(160)), 0]
    np.testing.assert_allclose((up[21] - up[17]) / 0.5, wanted, atol=1e-12)
    for side, elbow, wrist in (("left", 18, 20), ("right", 19, 21)):
        bent = placed(file, **{f"{side}_elbow": 90})
        np.testing.assert_allclose(
            bent[wrist] - bent[elbow], [0, 0, 0.25], atol=1e-12
        )  # forearm to the front
        ahead = placed(file, **{f"{side}_forward": 90})
        np.testing.assert_allclose(ahead[wrist] - ahead[elbow], [0, 0, 0.25], atol=1e-12)
    hanging = placed(file, left_raise=0, left_swing=-90)
    np.testing.assert_allclose(hanging[20] - hanging[18], [0, 0, 0.25], atol=1e-12)
    sitting = placed(file, right_hip=90, right_knee=90)
    np.testing.assert_allclose(sitting[5] - sitting[2], [0, 0, 0.4], atol=1e-12)  # thigh to the front
    np.testing.assert_allclose(sitting[8] - sitting[5], [0, -0.4, -0.02], atol=1e-12)  # shin down again
    wide = placed(file, left_spread=30, right_spread=30)
    assert wide[7][0] == pytest.approx(-wide[8][0], abs=1e-12)
    assert wide[7][0] > JOINTS[7][0] + 0.3
    leaning = placed(file, lean=60)
    assert leaning[15][2] > 0.2
    assert placed(file, nod=30)[15][1] == pytest.approx(JOINTS[15][1], abs=0.05)
    turned = placed(file, yaw=90)
    np.testing.assert_allclose(
        turned[20] - JOINTS[0],
        Rotation.from_euler("y", 90, degrees=True).apply(JOINTS[20] - JOINTS[0]),
        atol=1e-12,
    )


def test_both_sides_mirror_each_other(file):
    moves = {
        "raise": 50,
        "forward": 20,
        "swing": -15,
        "twist": 25,
        "elbow": 70,
        "pronate": 30,
        "wrist": 20,
        "shrug": 9,
    }
    moves |= {"hip": 40, "spread": 15, "hip_turn": 20, "knee": 50, "ankle": 10}
    left = placed(file, **{f"left_{name}": value for name, value in moves.items()})
    right = placed(file, **{f"right_{name}": value for name, value in moves.items()})
    for one, other in ((16, 17), (18, 19), (20, 21), (1, 2), (4, 5), (7, 8), (10, 11)):
        np.testing.assert_allclose(left[one] * [-1, 1, 1], right[other], atol=1e-12)


def test_poses_stay_within_their_limits_and_vary_as_stated():
    drawn = poses.draw(20_000, np.random.default_rng(0))
    limits = [*poses.CENTRAL.values(), *poses.SIDED.values(), *poses.SIDED.values()]
    for values, (_, _, least, most) in zip(drawn.T, limits, strict=True):
        assert least <= values.min() < values.max() <= most
    places = {name: place for place, name in enumerate(poses.MOVEMENTS)}
    yaw = drawn[:, places["yaw"]]
    wide = 1 - poses.TAIL + poses.TAIL * poses.WIDER**2
    assert yaw.std() == pytest.approx(12 * wide**0.5, rel=0.05)
    level = (drawn[:, places["left raise"]] > 80) & (drawn[:, places["left raise"]] < 100)
    assert level.mean() > 0.15  # arms of a T-pose are common


def test_joints_of_another_body_are_refused(file):
    named = Body(**{**body_files.read(file).__dict__, "names": tuple(map(str, range(22)))})
    with pytest.raises(DataError, match="has no joint 'root'"):
        poses.skeleton(named)
