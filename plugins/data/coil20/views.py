"""Reading of COIL-20 as it is distributed: one MATLAB file, or the folder of processed images."""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from framework.datasets.images import Crop
from framework.datasets.matlab import read_variables
from framework.errors import DataError, shorten

OBJECTS, VIEWS, STEP_DEG = 20, 72, 5
FILE = "COIL20.mat"
REMEDY = (
    f"Set data.root to a folder that holds {FILE} (X 1440 × 1024 uint8, Y 1440 × 1), or obj1__0.png to obj20__71.png "
    "(coil-20-proc)."
)


def read_views(root: str | None, side: int) -> UInt8[Tensor, "object view 1 side side"]:
    """Read every view of every object, `side` pixels a side; view k is at 5k degrees.

    Raises:
        DataError: `root` is None or has neither layout, or a file is missing, unreadable or of another shape.
    """
    path = find_views(root)
    return _read_images(path, side) if path.is_dir() else _read_matlab(path, side)


def find_views(root: str | None) -> Path:
    """Return the MATLAB file of all views, or the folder of their images.

    Raises:
        DataError: `root` is None, or has neither layout.
    """
    if root is None:
        raise DataError(
            "data.root is not set: COIL-20 is published for research by Columbia University and is not generated. "
            + REMEDY
        )
    folder = Path(root).expanduser()
    if folder.is_file():
        return folder
    if (folder / FILE).is_file():
        return folder / FILE
    if (folder / "obj1__0.png").is_file():
        return folder
    raise DataError(f"data.root = {folder} holds neither {FILE} nor obj1__0.png. {REMEDY}")


def _read_matlab(file: Path, side: int) -> Tensor:
    variables = read_variables(file, remedy=REMEDY)
    if "X" not in variables or "Y" not in variables:
        raise DataError(
            f"{file}: The file holds {shorten(', '.join(variables)) or 'nothing'}, but X and Y are required. {REMEDY}"
        )
    pixels, labels = np.asarray(variables["X"]), np.asarray(variables["Y"]).ravel()
    if (
        pixels.shape != (OBJECTS * VIEWS, 1024)
        or pixels.dtype != np.uint8
        or labels.shape != (OBJECTS * VIEWS,)
    ):
        raise DataError(
            f"{file}: X has the type {pixels.dtype} and the shape {pixels.shape}, and Y holds {labels.size} numbers; "
            f"expected uint8 of shape ({OBJECTS * VIEWS}, 1024) and {OBJECTS * VIEWS} numbers. {REMEDY}"
        )
    names, counts = np.unique(labels, return_counts=True)
    if names.tolist() != [*range(1, OBJECTS + 1)] or (counts != VIEWS).any():
        raise DataError(
            f"{file}: Y holds {len(names)} different numbers, which occur {counts.min()} to {counts.max()} times; "
            f"expected the numbers 1 to {OBJECTS} of the objects, {VIEWS} times each. {REMEDY}"
        )
    order = np.argsort(labels, kind="stable")
    # MATLAB stores an image column by column
    square = pixels[order].reshape(OBJECTS, VIEWS, 1, 32, 32).swapaxes(-1, -2)
    views = torch.from_numpy(np.ascontiguousarray(square))
    if side == 32:
        return views
    resized = torch.nn.functional.interpolate(
        views.flatten(0, 1).float(), size=(side, side), mode="bilinear", antialias=True, align_corners=False
    )
    return resized.round().clamp(0, 255).to(torch.uint8).unflatten(0, (OBJECTS, VIEWS))


def _read_images(folder: Path, side: int) -> Tensor:
    views = []
    for number in range(1, OBJECTS + 1):
        files = [folder / f"obj{number}__{view}.png" for view in range(VIEWS)]
        missing = [file.name for file in files if not file.is_file()]
        if missing:
            raise DataError(
                f"{folder}: {missing[0]} is missing, and so are {len(missing) - 1} other views of this object. {REMEDY}"
            )
        views.append(torch.stack([Crop(file, None, 0.0, side, 1).read() for file in files]))
    return torch.stack(views)
