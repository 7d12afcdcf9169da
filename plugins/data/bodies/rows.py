"""Rows of the contract: scans of a doll, and a few people in FAUST's layout."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image

from framework.geometry.camera import Camera
from framework.target import Target
from framework.testing.rows import DAMAGES, DataRow, EncoderRow, HeadRow, MetricRow
from framework.testing.sample_files import meshes, write_ply
from plugins.data.bodies import scan_layout
from plugins.data.bodies.figure import figure_of
from plugins.data.bodies.scan_layout import Registration

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
    """Return the arrays of a body with a small octahedron around every joint, which follows that joint alone."""
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
    """Write the doll to a folder, and return the parameter that names its file."""
    np.savez(folder / "doll.npz", **doll())  # type: ignore[arg-type]
    return {"body": str(folder / "doll.npz")}


def small_body() -> Mapping[str, str]:
    """Return the parameter of the doll's file, in a folder that lasts as long as this process."""
    return body_file(Path(FOLDER.name))


def cut_out(folder: Path) -> Sequence[Path]:
    """Write two images with an alpha channel, and return their paths."""
    files = [folder / "one.png", folder / "other.png"]
    for number, file in enumerate(files):
        pixels = np.random.default_rng(number).integers(0, 256, (16, 12, 4), dtype=np.uint8)
        Image.fromarray(pixels).save(file)
    return files


def person(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the mesh of a person with its own shape and pose, 40 vertices, metres, and a scan of 300 points."""
    mesh = np.random.default_rng(0).normal(0, 0.3, (40, 3))
    mesh = mesh * (1 + number // 10 / 20) + 0.1 * np.sin(3 * mesh[:, [1, 2, 0]] + number % 10) + [0, 1.0, 0]
    near = np.random.default_rng(number).integers(0, 40, 300)
    return mesh, mesh[near] + np.random.default_rng(number + 1).normal(0, 0.01, (300, 3))


def people(folder: Path) -> Mapping[str, str]:
    """Write two scans each of four of FAUST's ten people, and return the parameter that names their folder."""
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    for number in (0, 3, 70, 75, 80, 81, 90, 99):
        mesh, scan = person(number)
        write_ply(folder / f"training/registrations/tr_reg_{number:03}.ply", mesh, faces)
        write_ply(folder / f"training/scans/tr_scan_{number:03}.ply", scan, faces[:1])
    return {"root": str(folder)}


def scanned(folder: Path) -> Mapping[str, str]:
    """Write six subjects of 40 coloured vertices, and return the parameter that names their folder.

    Each has two photographs of 12 × 9 pixels of noise with random masks, and a texture.
    """
    folder.mkdir(exist_ok=True)
    names = {"train": ("ann", "bob", "cleo"), "validation": ("dan",), "test": ("eve", "fay")}
    scan_layout.write_splits(folder, names)
    for number, name in enumerate(name for some in names.values() for name in some):
        home, random = folder / "subjects" / name, np.random.default_rng(number)
        scan_layout.write_registration(home / "registration_7k.ply", colored(number))
        view = Camera(
            torch.diag(torch.tensor([1.0, -1, -1])),
            torch.tensor([0, 1, 3.0]),
            (12.0, 12.0),
            (4.0, 5.5),
            12,
            9,
        )
        scan_layout.write_cameras(
            home / "cameras.json", {"front": view, "near": replace(view, focal=(14.0, 15.0))}
        )
        for place in ("images/front", "images/near", "masks/front", "masks/near"):
            pixels = random.integers(0, 256, (12, 9, 3), np.uint8)
            file = home / f"{place}.png"
            file.parent.mkdir(exist_ok=True)
            Image.fromarray(pixels if "images" in place else pixels[..., 0]).save(file)
        Image.fromarray(random.integers(0, 256, (7, 5, 3), np.uint8)).save(home / "texture.png")
    places = np.random.default_rng(6).random((6, 2), np.float32)
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    np.savez(folder / "topology_7k.npz", faces=faces, uv=places, uv_faces=[(0, 1, 2), (5, 4, 3)])
    return {"root": str(folder)}


def seen(count: int) -> torch.Tensor:
    """Return inputs of `count` subjects, in turn, 3 m in front of the camera."""
    people = [colored(number % 6) for number in range(count)]
    clouds = [torch.cat([one.vertices * 2 + torch.tensor([0, -2, 3]), one.colors / 255], 1) for one in people]
    return torch.stack(clouds) if clouds else torch.empty(0, 40, 6)


def colored(number: int) -> Registration:
    """Return a person's mesh with random colours."""
    colors = np.random.default_rng(number).integers(0, 256, (40, 3), np.uint8)
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    return Registration(
        torch.from_numpy(person(number)[0]).float(), torch.from_numpy(colors), torch.from_numpy(faces)
    )


def colored_meshes(folder: Path) -> Sequence[Path]:
    """Write two meshes with vertex colours, and return their paths."""
    files = [folder / "one.ply", folder / "other.ply"]
    for number, file in enumerate(files):
        scan_layout.write_registration(file, colored(number))
    return files


DOLL = small_body()
SCANNED = scanned(Path(FOLDER.name) / "scans")
NUMBERS = figure_of(DOLL["body"]).names
SMALL = {"renderer": "rasterizer", "topologies": ["7k"], "views": 2}
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
                "than what it looks for. A product of torch's normals; test_fit_pose.py has its log_prob and entropy",
                "every raw number counts": "they are an image, of which one pixel alone may move no fit",
                "target's unit": "poses are radians and metres, in which its renderer draws",
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
        EncoderRow(
            "six people's textures",
            (40, 6),
            {
                **SCANNED,
                "renderer": "rasterizer",
                "height": 24,
                "width": 18,
                "textures": {"name": "human_scans", **SCANNED},
            },
            leave_out={
                "finite on extreme inputs": "of constant colours there is nobody; test_textures.py has others"
            },
            inputs=seen,
        ),
        EncoderRow(
            "a doll, its silhouette",
            (132, 6),
            {**DOLL, "renderer": "rasterizer", "height": 9, "width": 14, "ground": True},
        ),
    ),
    "pose_error": (MetricRow("a doll", Target("real", NUMBERS)),),
    "human_scans": (
        DataRow(
            "a dressed doll",
            {**SMALL, "train": 3, "validation": 1, "test": 2, "height": 24, "width": 18, "texture_side": 0},
            write=body_file,
            synthetic=True,
            files=colored_meshes,
            fragile={"doll.npz": DAMAGES},
            changes={"data_seed": 1, "test": 3, "views": 3, "width": 20},
        ),
        DataRow(
            "six people",
            {**SMALL, **DOLL, "train": 1, "validation": 1, "test": 1, "height": 12, "width": 9},
            write=scanned,
            synthetic=False,
            files=colored_meshes,
            fragile={
                "test.txt": ("missing", "empty", "folder", "garbage"),
                **{f"subjects/*/{name}": DAMAGES for name in ("registration_7k.ply", "cameras.json")},
                **{f"subjects/*/{name}/*.png": DAMAGES for name in ("images", "masks")},
            },
        ),
        DataRow(
            "six silhouettes",
            {
                **SMALL,
                **DOLL,
                "train": 1,
                "validation": 1,
                "test": 1,
                "height": 12,
                "width": 9,
                "shows": "subject",
            },
            write=scanned,
            synthetic=False,
            files=colored_meshes,
        ),
    ),
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
            {"points": 200, **DOLL},
            write=people,
            synthetic=False,
            files=meshes,
            fragile={"training/scans/*.ply": DAMAGES, "training/registrations/*.ply": DAMAGES},
            changes={"data_seed": 1, "test": [8]},
        ),
    ),
}
