"""Reading of COIL-20 as it is distributed: one MATLAB file, or the folder of processed images."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from framework.datasets.images import Crop
from framework.datasets.matlab import read_variables
from framework.errors import DataError, shown

OBJECTS, VIEWS, STEP_DEG = 20, 72, 5
FILE = "COIL20.mat"
WANTED = (
    f"Wanted: the folder that holds {FILE} (X 1440 × 1024, Y 1440 × 1), or obj1__0.png to obj20__71.png "
    "(coil-20-proc)."
)


def read_views(root: str | None, side: int) -> UInt8[Tensor, "object view 1 side side"]:
    """Read every view of every object; view k is at 5k degrees.

    Raises:
        DataError: there is no root, it has neither layout, or a file is missing, unreadable or of another shape.
    """
    if root is None:
        raise DataError(
            "data.root is not set: COIL-20 is published for research by Columbia University and is not generated. "
            + WANTED
        )
    folder = Path(root).expanduser()
    if folder.is_file():
        return _matlab(folder, side)
    if (folder / FILE).is_file():
        return _matlab(folder / FILE, side)
    if (folder / "obj1__0.png").is_file():
        return _folder(folder, side)
    raise DataError(f"data.root = {folder}: neither {FILE} nor obj1__0.png is there. {WANTED}")


def _matlab(file: Path, side: int) -> Tensor:
    found = read_variables(file, remedy=WANTED)
    if "X" not in found or "Y" not in found:
        raise DataError(f"{file} holds {shown(', '.join(found)) or 'nothing'}. {WANTED}")
    pixels, labels = np.asarray(found["X"]), np.asarray(found["Y"]).ravel()
    if (
        pixels.shape != (OBJECTS * VIEWS, 1024)
        or pixels.dtype != np.uint8
        or labels.shape != (OBJECTS * VIEWS,)
    ):
        raise DataError(f"{file}: X came as {pixels.dtype} {pixels.shape}, Y as {labels.shape}. {WANTED}")
    names, counts = np.unique(labels, return_counts=True)
    if names.tolist() != [*range(1, OBJECTS + 1)] or (counts != VIEWS).any():
        raise DataError(f"{file}: Y does not name {OBJECTS} objects with {VIEWS} views each. {WANTED}")
    order = np.argsort(labels, kind="stable")
    square = pixels[order].reshape(OBJECTS, VIEWS, 1, 32, 32).swapaxes(-1, -2)  # MATLAB stores columns
    views = torch.from_numpy(np.ascontiguousarray(square))
    if side == 32:
        return views
    resized = torch.nn.functional.interpolate(
        views.flatten(0, 1).float(), size=(side, side), mode="bilinear", antialias=True, align_corners=False
    )
    return resized.round().clamp(0, 255).to(torch.uint8).unflatten(0, (OBJECTS, VIEWS))


def _folder(folder: Path, side: int) -> Tensor:
    rows = []
    for number in range(1, OBJECTS + 1):
        files = [folder / f"obj{number}__{view}.png" for view in range(VIEWS)]
        missing = [file.name for file in files if not file.is_file()]
        if missing:
            raise DataError(
                f"{folder}: {missing[0]} is missing, and {len(missing) - 1} more of its object. {WANTED}"
            )
        rows.append(torch.stack([Crop(file, None, 0.0, side, 1).read() for file in files]))
    return torch.stack(rows)
