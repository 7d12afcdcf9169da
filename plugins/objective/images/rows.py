"""Contract-test cases: distances between images or features, and discriminators, on images of few pixels."""

from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from framework.target import Target
from framework.testing.rows import ObjectiveRow
from plugins.objective.images.vgg import TAPS, WIDTHS, Depth, layers_of

FOLDER = TemporaryDirectory()
IMAGES = Target("image", ("red", "green", "blue"), size=(20, 16))
KINKS = {"gradient": 0.05}
"""Largest allowed error of a gradient: finite differences that step over the kink of a ReLU are inexact."""


def file_of(depth: Depth) -> str:
    """Write a file with random weights of the layers that `read_vgg` reads, and return its path.

    The weights have torchvision's names.
    """
    generator, channels, state = torch.Generator().manual_seed(depth), 3, {}
    for block, _, index in layers_of(depth, TAPS[depth][-1]):
        width = WIDTHS[block]
        weight = torch.randn(width, channels, 3, 3, generator=generator, dtype=torch.float32)
        # half precision: a file of half the size
        state[f"features.{index}.weight"] = (weight * (2 / (9 * channels)) ** 0.5).half()
        state[f"features.{index}.bias"] = torch.zeros(width, dtype=torch.float16)
        channels = width
    path = Path(FOLDER.name) / f"vgg{depth}.pth"
    torch.save(state, path)
    return str(path)


ROWS = {
    "perceptual": (
        ObjectiveRow("random weights in torchvision's file", IMAGES, {"weights": file_of(16)}, limits=KINKS),
    ),
    "random_features": (
        ObjectiveRow("narrow", IMAGES, {"width": 4}, limits=KINKS),
        ObjectiveRow("nothing kept", IMAGES, {"width": 4, "depth": 1, "cache": 0}, limits=KINKS),
    ),
    "squared_error": (ObjectiveRow("images", IMAGES),),
    "patch_gan": (
        ObjectiveRow("two scales", IMAGES, {"width": 4}),
        ObjectiveRow("no features", IMAGES, {"width": 4, "scales": 1, "layers": 1, "feature_matching": 0.0}),
    ),
}
