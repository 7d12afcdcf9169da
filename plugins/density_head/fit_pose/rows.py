"""Contract-test cases: the pose of a doll."""

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
                "integral by draws": "the check fits a covariance to its draws; of so many numbers it is further off "
                "than what it looks for. A product of torch's normals; test_fit_pose.py has its log_prob and entropy",
                "every raw parameter is read": "they are an image, of which one pixel alone may move no fit",
                "target's unit": "poses are radians and metres, in which its renderer draws",
            },
        ),
    ),
}
