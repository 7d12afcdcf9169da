"""Files of body models: the layout of SMPL's published files, .npz or .pkl, and a layout of our own.

SMPL and later models with linear blend skinning are published in this layout, for V vertices, J joints, F faces and B
shape coefficients: `v_template` (V, 3), `shapedirs` (V, 3, B), `J_regressor` (J, V), `weights` (V, J), `kintree_table`
(2, J) whose first row holds parents, `f` (F, 3), and in most files `posedirs` (V, 3, number of pose features). The
number of pose features is 9 (J - 1) or 4 (J - 1) + 1. Other keys are not read. Pickles are read by
framework.bodies.restricted_pickle, which calls no function that a file names.
"""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from framework.bodies import restricted_pickle
from framework.bodies.body import Body
from framework.errors import DataError, shorten
from framework.storage.arrays import read_npz
from framework.storage.files import replacing
from framework.storage.limits import MOST_DISPLACEMENTS as LARGEST
from framework.storage.limits import MOST_NUMBERS
from framework.storage.reading import read_bytes, require_numbers, translate_errors

NEEDED = ("v_template", "shapedirs", "J_regressor", "weights", "kintree_table", "f")
OWN = ("template", "faces", "weights", "parents", "joints", "shapes", "joint_shapes")
WANTED = f"Give a file with the arrays {', '.join(NEEDED)}, and posedirs if the body has pose blend shapes."


def read(file: Path) -> Body:
    """Read a body model from an .npz or .pkl file in the layout of SMPL's published files (`v_template`, …).

    Raises:
        DataError: the file does not exist, has another format, holds something other than arrays and plain values, or
            an array is missing or has another shape. The message names the cause.
    """
    with translate_errors(file, "a body model", missing="expected a body model. Correct the path."):
        if file.suffix == ".npz":
            content = read_bytes(file)
            arrays = read_npz(content, (*NEEDED, "posedirs"))
            require_numbers(sum(array.size for array in arrays.values()), MOST_NUMBERS, len(content))
            return _body(file, arrays)
        if file.suffix == ".pkl":
            return _body(file, _unpickled(file))
    raise DataError(
        f"{file}: the name of a body model's file must end in .npz or .pkl. Rename the file, or choose another one."
    )


def save(body: Body, file: Path) -> None:
    """Write a body as an .npz file in the project's own layout; after an error there is no incomplete file."""
    arrays = {name: np.asarray(getattr(body, name)) for name in OWN}
    arrays |= {"source": np.array(body.source), "names": np.array(body.names, dtype=np.str_)}
    for name in ("pose_shapes", "uv", "uv_faces"):
        if getattr(body, name) is not None:
            arrays[name] = getattr(body, name)
    with replacing(file) as part, part.open("wb") as stream:
        np.savez(stream, allow_pickle=False, **arrays)


def load(file: Path) -> Body:
    """Read a body that `save` wrote.

    Raises:
        DataError: the file is missing or damaged.
    """
    with translate_errors(file, "a body", "Delete the file: it is generated again."):
        arrays = read_npz(read_bytes(file))
        parents = tuple(int(parent) for parent in arrays.pop("parents"))
        names = tuple(str(name) for name in arrays.pop("names"))
        return Body(source=str(arrays.pop("source")), parents=parents, names=names, **arrays)


def _unpickled(file: Path) -> Mapping[str, Any]:
    try:
        content = restricted_pickle.load(read_bytes(file))
    except restricted_pickle.PickleRefused as error:
        raise DataError(
            f"{file}: the pickle is refused: {error}. Only arrays are read from pickles; nothing in this file was "
            f"run. {WANTED}"
        ) from error
    if not isinstance(content, dict):
        raise DataError(
            f"{file}: the file contains an object of type {type(content).__name__}, not a dictionary. {WANTED}"
        )
    return content


def _body(file: Path, content: Mapping[str, Any]) -> Body:
    missing = [name for name in NEEDED if name not in content]
    if missing:
        names = shorten(", ".join(map(str, content))) or "nothing"
        raise DataError(
            f"{file}: the arrays {', '.join(missing)} are missing; the file contains {names}. {WANTED}"
        )
    posedirs = content.get("posedirs")
    arrays = {name: _numbers(file, name, content[name]) for name in NEEDED}
    template, shapes, regressor = arrays["v_template"], arrays["shapedirs"], arrays["J_regressor"]
    if shapes.ndim == 2:  # a model with a single coefficient
        shapes = shapes[..., None]
    table = arrays["kintree_table"]
    if (
        template.ndim != 2
        or shapes.shape[:2] != template.shape
        or table.ndim != 2
        or regressor.shape != (table.shape[1], len(template))
        or not template.size
        or len(regressor) * math.prod(shapes.shape[1:]) > LARGEST
    ):
        shapes = ", ".join(f"{name} {array.shape}" for name, array in arrays.items())
        raise DataError(f"{file}: the shapes of the arrays do not fit together: {shapes}. {WANTED}")
    wanted = template.dtype
    return Body(
        source=str(file),
        template=template,
        faces=arrays["f"].astype(np.int64),
        weights=arrays["weights"].astype(wanted),
        # the root's parent is -1, which reads as a large number if it was stored unsigned
        parents=tuple(
            -1 if not 0 <= parent < table.shape[1] else int(parent) for parent in table[0].tolist()
        ),
        # joints are linear in the vertices (Loper et al. 2015, eq. 10), so each coefficient displaces them as well
        joints=(regressor @ template).astype(wanted),
        shapes=shapes.astype(wanted),
        joint_shapes=np.einsum("jv,vcs->jcs", regressor, shapes).astype(wanted),
        pose_shapes=None if posedirs is None else _numbers(file, "posedirs", posedirs).astype(wanted),
    )


def _numbers(file: Path, name: str, value: Any) -> np.ndarray:
    # lists are refused: nested lists that repeat one another would expand into an array of unlimited size
    if not isinstance(value, np.ndarray | np.generic | int | float | str):
        raise DataError(f"{file}: {name} has the type {type(value).__name__}; expected an array. {WANTED}")
    array = np.asarray(value)
    if array.dtype.kind not in "iuf" or not np.isfinite(array).all():
        raise DataError(
            f"{file}: {name} has the type {array.dtype} and the shape {array.shape}, and it holds something other than "
            f"finite numbers. {WANTED}"
        )
    if array.dtype.kind == "f":
        return array.astype(np.float32 if array.dtype.itemsize <= 4 else np.float64)
    return array if name in ("f", "kintree_table") else array.astype(np.float64)
