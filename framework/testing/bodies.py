"""Small bodies for checks of plugins that read or draw people: a doll, and people of 40 coloured vertices."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from framework.bodies.parametric import ParametricBody
from framework.datasets import scan_layout
from framework.datasets.scan_layout import RegisteredMesh
from framework.geometry.camera import Camera

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
    """Return the arrays of a body model with a small octahedron around every joint; it follows this joint alone."""
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


def write_body_file(folder: Path) -> Mapping[str, str]:
    """Write the doll to a file in a folder, and return the parameters {"body": path of the file} of a plugin."""
    np.savez(folder / "doll.npz", **doll())  # type: ignore[arg-type]
    return {"body": str(folder / "doll.npz")}


def small_body() -> Mapping[str, str]:
    """Write the doll to a file, and return {"body": path of the file}; the file lasts as long as this process."""
    return write_body_file(Path(FOLDER.name))


def person(number: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a mesh of a person, 40 vertices in metres, and a scan of 300 points; shape and pose depend on `number`."""
    mesh = np.random.default_rng(0).normal(0, 0.3, (40, 3))
    mesh = mesh * (1 + number // 10 / 20) + 0.1 * np.sin(3 * mesh[:, [1, 2, 0]] + number % 10) + [0, 1.0, 0]
    near = np.random.default_rng(number).integers(0, 40, 300)
    return mesh, mesh[near] + np.random.default_rng(number + 1).normal(0, 0.01, (300, 3))


def write_subjects(folder: Path) -> Mapping[str, str]:
    """Write six subjects of 40 coloured vertices to a folder, and return {"root": path of the folder}.

    "root" is the parameter with which data sets of scans find their folder. Each subject has two photographs and masks
    of 12 × 9 random pixels, and a texture.
    """
    folder.mkdir(exist_ok=True)
    names = {"train": ("ann", "bob", "cleo"), "validation": ("dan",), "test": ("eve", "fay")}
    scan_layout.write_splits(folder, names)
    for number, name in enumerate(name for split_names in names.values() for name in split_names):
        home, random = folder / "subjects" / name, np.random.default_rng(number)
        scan_layout.write_registration(home / "registration_7k.ply", colored_mesh(number))
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
        for image_name in ("images/front", "images/near", "masks/front", "masks/near"):
            pixels = random.integers(0, 256, (12, 9, 3), np.uint8)
            file = home / f"{image_name}.png"
            file.parent.mkdir(exist_ok=True)
            Image.fromarray(pixels if "images" in image_name else pixels[..., 0]).save(file)
        Image.fromarray(random.integers(0, 256, (7, 5, 3), np.uint8)).save(home / "texture.png")
    uv = np.random.default_rng(6).random((6, 2), np.float32)
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    np.savez(folder / "topology_7k.npz", faces=faces, uv=uv, uv_faces=[(0, 1, 2), (5, 4, 3)])
    return {"root": str(folder)}


def colored_mesh(number: int) -> RegisteredMesh:
    """Return the mesh of `person(number)` with random colours."""
    colors = np.random.default_rng(number).integers(0, 256, (40, 3), np.uint8)
    faces = np.array([(0, 1, 2), (2, 1, 3)])
    return RegisteredMesh(
        torch.from_numpy(person(number)[0]).float(), torch.from_numpy(colors), torch.from_numpy(faces)
    )


def random_parameters(body_model: ParametricBody, seed: int = 0, size: float = 1.0) -> Tensor:
    """Return random parameters of a body within its limits, (number,) float64, multiplied by `size`."""
    random = np.random.default_rng(seed)
    parameters = torch.from_numpy(random.normal(0, 1, len(body_model.names))) * body_model.spread
    parameters[:6] = torch.from_numpy(random.normal(0, 1, 6)) * 0.2
    return size * torch.minimum(torch.maximum(parameters, body_model.limits[:, 0]), body_model.limits[:, 1])


DOLL = small_body()
