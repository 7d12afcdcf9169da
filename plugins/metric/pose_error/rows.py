"""Contract-test cases: the pose of the small body model `framework.testing.bodies.doll`."""

from framework.bodies.parametric import parametric_body
from framework.target import Target
from framework.testing.bodies import DOLL
from framework.testing.rows import MetricRow

ROWS = {
    "pose_error": (MetricRow("a doll", Target("real", parametric_body(DOLL["body"]).names)),),
}
