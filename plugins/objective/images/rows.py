"""Rows of the contract: distances of features and discriminators, on images of few pixels."""

from framework.target import Target
from framework.testing.rows import ObjectiveRow

IMAGES = Target("image", ("red", "green", "blue"), size=(20, 16))
KINKS = {"gradient": 0.05}
"""Differences step over where a unit is switched on."""

ROWS = {
    "random_features": (
        ObjectiveRow("narrow", IMAGES, {"width": 4}, limits=KINKS),
        ObjectiveRow("nothing kept", IMAGES, {"width": 4, "depth": 1, "cache": 0}, limits=KINKS),
    ),
    "patch_gan": (
        ObjectiveRow("two scales", IMAGES, {"width": 4}),
        ObjectiveRow("no features", IMAGES, {"width": 4, "scales": 1, "layers": 1, "feature_matching": 0.0}),
    ),
}
