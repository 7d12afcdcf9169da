"""Contract-test cases: the pose of the small body model `framework.testing.bodies.doll`."""

from framework.bodies.parametric import parametric_body
from framework.target import Target
from framework.testing.bodies import DOLL
from framework.testing.rows import HeadRow

ROWS = {
    "fit_pose": (
        HeadRow(
            "a doll",
            Target("real", parametric_body(DOLL["body"]).names),
            {**DOLL, "renderer": "rasterizer", "height": 16, "width": 12, "steps": 1, "restarts": 0},
            leave_out={
                "integral by draws": "a covariance of 30 numbers from samples is too inexact for this check; "
                "test_fit_pose.py compares log_prob and entropy with SciPy",
                "every raw parameter is read": "a change of a single pixel of the image may leave the fit as it is",
                "target's unit": "the renderer needs poses in radians and metres",
            },
        ),
    ),
}
