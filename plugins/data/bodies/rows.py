"""Rows of the contract: scans of a doll, and a few people in FAUST's layout."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from PIL import Image

from framework.target import Target
from framework.testing.rows import DAMAGES, DataRow, EncoderRow, HeadRow, MetricRow
from framework.testing.sample_files import meshes, write_ply
from plugins.data.bodies.figure import figure_of

FOLDER = TemporaryDirectory()
# the SMPL family's first 22 joints: pelvis, hips, spine, knees, spine, ankles, spine, toes, neck, collars, head,
# shoulders, elbows, wrists; a T-pose of a person of 1.7 m
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
JOINTS = np.array(
    [
        (0, 0.95, 0),
        *((0.1, 0.9, 0), (-0.1, 0.9, 0), (0, 1.05, 0), (0.1, 0.5, 0), (-0.1, 0.5, 0), (0, 1.18, 0)),
        *((0.1, 0.1, -0.02), (-0.1, 0.1, -0.02), (0, 1.25, 0), (0.1, 0.02, 0.1), (-0.1, 0.02, 0.1)),
        *((0, 1.45, 0), (0.08, 1.38, 0), (-0.08, 1.38, 0), (0, 1.55, 0.02), (0.2, 1.4, 0), (-0.2, 1.4, 0)),
        *((0.45, 1.4, 0), (-0.45, 1.4, 0), (0.7, 1.4, 0), (-0.7, 1.4, 0)),
    ]
)


def doll() -> dict[str, np.ndarray]:
    """A small octahedron around every joint, which follows it alone."""
    around = 0.04 * np.array([(1, 0, 0), (-1, 0, 0), (0, 1, 0), (0, -1, 0), (0, 0, 1), (0, 0, -1)])
    faces = np.array([(0, 2, 4), (2, 1, 4), (1, 3, 4), (3, 0, 4), (2, 0, 5), (1, 2, 5), (3, 1, 5), (0, 3, 5)])
    template = np.concatenate([joint + around for joint in JOINTS])
    random = np.random.default_rng(0)
    return {
        "v_template": template,
        "shapedirs": np.concatenate(
            [0.05 * template[..., None], random.normal(0, 1e-3, (len(template), 3, 3))], 2
        ),
        "J_regressor": np.kron(np.eye(22), np.full((1, 6), 1 / 6)),
        "weights": np.kron(np.eye(22), np.ones((6, 1))),
        "kintree_table": np.array([PARENTS, range(22)]),
        "f": np.concatenate([faces + 6 * joint for joint in range(22)]),
    }


def body_file(folder: Path) -> Mapping[str, str]:
    np.savez(folder / "doll.npz", **doll())  # type: ignore[arg-type]
    return {"body": str(folder / "doll.npz")}


def small_body() -> Mapping[str, str]:
    """The doll, in a folder that lasts as long as this process."""
    return body_file(Path(FOLDER.name))


def cut_out(folder: Path) -> Sequence[Path]:
    """Two pictures with an alpha channel."""
    files = [folder / "one.png", folder / "other.png"]
    for number, file in enumerate(files):
        pixels = np.random.default_rng(number).integers(0, 256, (16, 12, 4), dtype=np.uint8)
        Image.fromarray(pixels).save(file)
    return files


def person(number: int) -> tuple[np.ndarray, np.ndarray]:
    """A person's own shape in a pose of its own, 40 vertices, metres, and a scan of it with 300 points."""
    mesh = np.random.default_rng(0).normal(0, 0.3, (40, 3))
    mesh = mesh * (1 + number // 10 / 20) + 0.1 * np.sin(3 * mesh[:, [1, 2, 0]] + number % 10) + [0, 1.0, 0]
    near = np.random.default_rng(number).integers(0, 40, 300)
    return mesh, mesh[near] + np.random.default_rng(number + 1).normal(0, 0.01, (300, 3))


def people(folder: Path) -> Mapping[str, str]:
    """Two scans each of four of FAUST's ten people."""
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    for number in (0, 3, 70, 75, 80, 81, 90, 99):
        mesh, scan = person(number)
        write_ply(folder / f"training/registrations/tr_reg_{number:03}.ply", mesh, faces)
        write_ply(folder / f"training/scans/tr_scan_{number:03}.ply", scan, faces[:1])
    return {"root": str(folder)}


DOLL = small_body()
NUMBERS = figure_of(DOLL["body"]).names
ROWS = {
    "pose_from_image": (
        DataRow(
            "a doll",
            {"renderer": "rasterizer", "train": 3, "validation": 2, "test": 3, "height": 16, "width": 12},
            write=body_file,
            synthetic=True,
            files=cut_out,
            fragile={"doll.npz": DAMAGES},
            changes={
                "data_seed": 1,
                "test": 4,
                "pose_spread": 2.0,
                "turned_deg": 10.0,
                "moved": 0.1,
                "width": 16,
            },
        ),
    ),
    "fit_pose": (
        HeadRow(
            "a doll",
            Target("real", NUMBERS),
            {**DOLL, "renderer": "rasterizer", "height": 16, "width": 12, "steps": 1, "restarts": 0},
            leave_out={
                "integral by draws": "the check fits a covariance to its draws; of so many numbers it is further off "
                "than what it looks for. A product of torch's normals; test_fit_pose.py has its log_prob and entropy"
            },
        ),
    ),
    "rasterised": (
        EncoderRow("a doll", (132, 6), {**DOLL, "renderer": "rasterizer", "height": 16, "width": 12}),
        EncoderRow(
            "a doll, its depth",
            (132, 6),
            {**DOLL, "renderer": "rasterizer", "height": 9, "width": 14, "depth": True},
        ),
    ),
    "pose_error": (MetricRow("a doll", Target("real", NUMBERS)),),
    "registration": (
        DataRow(
            "a doll",
            {"train": 12, "validation": 4, "test": 9, "points": 200},
            write=body_file,
            synthetic=True,
            files=meshes,
            fragile={"doll.npz": DAMAGES},
            changes={"data_seed": 1, "test": 10, "shape_spread": 2.0},
        ),
    ),
    "faust": (
        DataRow(
            "four people",
            {"points": 200},
            write=people,
            synthetic=False,
            files=meshes,
            fragile={"training/scans/*.ply": DAMAGES, "training/registrations/*.ply": DAMAGES},
            changes={"data_seed": 1, "test": [8]},
        ),
    ),
}
