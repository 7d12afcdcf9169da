"""Contract-test cases: checkpoints with random weights, for points, for splats, and for other image sizes."""

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import torch

from framework.configuration.assembly import Resolved, build_predictor
from framework.configuration.description import Description
from framework.configuration.loading import PREFIX
from framework.configuration.schema import resolve
from framework.storage import checkpoints
from framework.target import Target
from framework.testing.rows import RendererRow
from plugins.renderer.smplpix.renderer import COLUMNS

FOLDER = TemporaryDirectory()

NEAR: dict[str, Any] = {"nearest": 0.1, "farthest": 20.0}
UNET = {"width": 6, "levels": 3}
SLIM = {"widths": [8, 12, 16]}


def projection_settings(size: tuple[int, int], name: str = "projection", **config: Any) -> dict[str, Any]:
    """Return the settings of an encoder that projects points onto an image of `size` (height, width)."""
    return {"name": name, "height": size[0], "width": size[1], **config}


def write_checkpoint(
    file: Path,
    encoders: Sequence[dict[str, Any]],
    size: tuple[int, int],
    points: int = 50,
    names: tuple[str, ...] = COLUMNS[3:],
    uncertainty: Sequence[dict[str, Any]] = (),
) -> str:
    """Write the checkpoint of a network with random weights, as a run on `human_scans` writes it; return its path.

    Args:
        file: path of the checkpoint.
        encoders: settings of the encoders.
        size: (height, width) of the image, pixels.
        points: number of points of the input.
        names: names of the target's channels.
        uncertainty: settings of the uncertainty wrappers.
    """
    state, target = {"height": size[0], "width": size[1]}, Target("image", names, size=size)
    config: Resolved = {
        "data": resolve("data", {"name": "human_scans", **state}),
        "density_head": resolve("density_head", "laplace_image"),
        "encoder": [resolve("encoder", part) for part in encoders],
        "uncertainty": [resolve("uncertainty", part) for part in uncertainty],
        "objective": [],
        "metric": [],
        "outliers": None,
    }
    shape = (points, len(COLUMNS))
    predictor = build_predictor(config, target, shape, 0, COLUMNS)
    with torch.no_grad():
        for parameter in predictor.parameters():
            parameter.add_(0.02 * torch.randn_like(parameter))
    described = Description(config, target, shape, COLUMNS, True, data_state=state)
    weights = {PREFIX + key: value for key, value in predictor.state_dict().items()}
    checkpoints.write({"framework": described.stored(), "state_dict": weights}, file)
    return str(file)


POINTS_ARE_DRAWN = {
    "no faces, only background": "the renderer also draws vertices without faces",
    "bad triangles are left out": "the renderer draws vertices, including those of a triangle without area",
    "points": "a network with random weights gives them arbitrary colours",
}
WHITE = {"empty view is background": 0.05}  # with random weights, an empty image is only nearly white
UNBOUNDED_WHITE = {
    "empty view is background": 0.2
}  # farther from white without a sigmoid that keeps the colour near 1
SLIM_RUN, SURFACE_RUN, UNET_RUN = (
    write_checkpoint(
        Path(FOLDER.name) / f"{network['name']}_{size[0]}.ckpt",
        [projection_settings(size, **of_points, **NEAR), network],
        size,
    )
    for network, size, of_points in (
        ({"name": "slim", **SLIM}, (48, 64), {}),
        ({"name": "slim", **SLIM, "residual": True}, (32, 32), {"splat": 3}),
        ({"name": "unet", **UNET}, (24, 20), {"levels": 2}),
    )
)
ROWS = {
    "smplpix": (
        RendererRow("slim", {"checkpoint": SLIM_RUN}, limits=WHITE, leave_out=POINTS_ARE_DRAWN),
        RendererRow(
            "over splats", {"checkpoint": SURFACE_RUN}, limits=UNBOUNDED_WHITE, leave_out=POINTS_ARE_DRAWN
        ),
        RendererRow(
            "unet of another size, bfloat16, whole frame",
            {"checkpoint": UNET_RUN, "precision": "bfloat16", "crop": "whole"},
            limits=WHITE,
            leave_out=POINTS_ARE_DRAWN,
        ),
    ),
}
