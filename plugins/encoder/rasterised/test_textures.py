"""Rendered images of textured meshes against ray casting, and the assignment of textures to subjects."""

import math
import shutil
from itertools import product

import numpy as np
import pytest
import torch
from PIL import Image

from framework.configuration.schema import build, resolve
from framework.datasets import scan_layout
from framework.datasets.scan_layout import RegisteredMesh
from framework.errors import ConfigError, DataError
from framework.testing.bodies import colored_mesh, write_subjects
from framework.testing.data_folders import damage
from framework.testing.rows import DAMAGES
from plugins.encoder.rasterised.rows import inputs_of

HEIGHT, WIDTH, SAMPLES = 24, 18, 4
PEOPLE = ("ann", "bob", "cleo", "dan", "eve", "fay")


def build_encoder(root, height=HEIGHT, width=WIDTH, **config):
    config_of_encoder = {
        "name": "rasterised",
        "root": str(root),
        "height": height,
        "width": width,
        "renderer": {"name": "rasterizer", "supersampling": SAMPLES},
        "textures": {"name": "human_scans", "root": str(root)},
        **config,
    }
    return build("encoder", resolve("encoder", config_of_encoder), input_shape=(40, 6), input_columns=())


@pytest.fixture
def root(tmp_path):
    write_subjects(tmp_path / "scans")
    return tmp_path / "scans"


def write_globe(root, sides):
    """Write all subjects as a bumpy ball with a texture seam, and a texture of smooth colours for the first subject.

    `sides` is the (height, width) of the texture, texels. The function returns the vertices, the faces, the texture
    coordinates, the faces of the texture coordinates, and the pixels of the texture.
    """
    rows, columns = 7, 9
    turn, rise = np.meshgrid(np.arange(columns + 1) / columns, np.arange(rows + 1) / rows)
    places = np.stack([turn, 1 - rise], -1).reshape(-1, 2)
    number = np.arange((rows + 1) * columns).reshape(rows + 1, columns)
    around = 2 * math.pi * turn[:, :-1], math.pi * rise[:, :-1]
    radius = 0.8 + 0.15 * np.sin(3 * around[0]) * np.sin(2 * around[1])
    ball = np.stack(
        [np.sin(around[1]) * np.sin(around[0]), np.cos(around[1]), np.sin(around[1]) * np.cos(around[0])], -1
    )
    vertices = (radius[..., None] * ball).reshape(-1, 3)
    faces, uv_faces = [], []
    for row, column in product(range(rows), range(columns)):
        for triangles, width, numbers in (
            (faces, columns, number),
            (uv_faces, columns + 1, np.arange((rows + 1) * (columns + 1)).reshape(rows + 1, -1)),
        ):
            a, b = numbers[row, column], numbers[row, (column + 1) % width]
            c, d = numbers[row + 1, column], numbers[row + 1, (column + 1) % width]
            triangles += [(a, c, b), (b, c, d)]
    for person, name in enumerate(PEOPLE):
        colors = np.random.default_rng(person).integers(0, 256, (len(vertices), 3), np.uint8)
        mesh = RegisteredMesh(
            torch.from_numpy(vertices).float(), torch.from_numpy(colors), torch.tensor(np.array(faces))
        )
        scan_layout.write_registration(root / f"subjects/{name}/registration_7k.ply", mesh)
    np.savez(root / "topology_7k.npz", faces=faces, uv=places, uv_faces=uv_faces)
    y, x = np.mgrid[: sides[0], : sides[1]]
    waves = [np.sin(x / 3 + phase) * np.cos(y / 4 + 2 * phase) for phase in range(3)]
    pixels = (127.5 + 120 * np.stack(waves, -1)).round().astype(np.uint8)
    Image.fromarray(pixels).save(root / "subjects/ann/texture.png")
    return vertices, np.array(faces), places, np.array(uv_faces), pixels


def decode_srgb(stored):
    """Return linear RGB of 8-bit sRGB numbers (IEC 61966-2-1)."""
    share = stored / 255
    return np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)


def trace_rays(vertices, faces, places, uv_faces, texels):
    """Return the image by one ray per sample: the texture of the nearest triangle that the ray meets.

    Intersections follow Möller & Trumbore (1997); texels are interpolated between the four nearest.
    """
    step = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    y = (np.arange(HEIGHT)[:, None] + step).ravel() - (HEIGHT - 1) / 2
    x = (np.arange(WIDTH)[:, None] + step).ravel() - (WIDTH - 1) / 2
    height, width = texels.shape[:2]
    image = np.ones((len(y), len(x), 3))
    a, b, c = vertices[faces].swapaxes(0, 1)
    first_side, second_side = b - a, c - a
    for row, column in product(range(len(y)), range(len(x))):
        ray = np.array([x[column], y[row], HEIGHT]) / HEIGHT  # from the origin
        across = np.cross(ray, second_side)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / (first_side * across).sum(1)
            second = -(a * across).sum(1) * scale
            third = (np.cross(-a, first_side) * ray).sum(1) * scale
            far = (np.cross(-a, first_side) * second_side).sum(1) * scale
            met = (second >= 0) & (third >= 0) & (second + third <= 1) & (far > 0)
        if not met.any():
            continue
        face = np.where(met, far, np.inf).argmin()
        weights = np.array([1 - second[face] - third[face], second[face], third[face]])
        u, v = weights @ places[uv_faces[face]]
        left, top = u * width - 0.5, (1 - v) * height - 0.5
        texel = np.zeros(3)
        for down, right in product((0, 1), (0, 1)):
            i, j = math.floor(top) + down, math.floor(left) + right
            texel += max(0, 1 - abs(top - i)) * max(0, 1 - abs(left - j)) * texels[i % height, j % width]
        image[row, column] = texel
    mean = image.reshape(HEIGHT, SAMPLES, WIDTH, SAMPLES, 3).mean((1, 3))
    return np.where(mean <= 0.0031308, 12.92 * mean, 1.055 * mean ** (1 / 2.4) - 0.055)


@pytest.mark.parametrize("times", [1, 2])
def test_a_textured_mesh_is_what_a_ray_through_every_sample_sees(root, times):
    """Check a texture of the largest size, and a finer one, which is averaged in linear RGB."""
    vertices, faces, places, uv_faces, pixels = write_globe(root, (32 * times, 96 * times))
    texels = decode_srgb(pixels).reshape(32, times, 96, times, 3).mean((1, 3))
    placed = vertices + np.array([0.1, -0.05, 2.0])
    colors = np.random.default_rng(0).integers(0, 256, (len(vertices), 3), np.uint8)
    cloud = torch.from_numpy(np.concatenate([placed, colors / 255], 1)).float()
    rendered = build_encoder(root)(cloud[None])[0].movedim(0, -1).numpy()
    wanted = trace_rays(placed, faces, places, uv_faces, texels)
    differences = np.abs(rendered - wanted).max(-1)
    assert 0.3 < (wanted < 0.99).any(-1).mean() < 0.9
    assert np.median(differences) < 1e-3 and (differences > 1 / 255).mean() < 0.02, (
        differences.max()
    )  # corners move by 1/512 sample
    plain = build_encoder(root, textures=None)(cloud[None])[0].movedim(0, -1).numpy()
    assert np.abs(plain - wanted).max() > 0.1


def test_everybody_wears_their_own_texture_however_lists_are_ordered(root):
    inputs = inputs_of(6)
    before = build_encoder(root)(inputs)
    assert all(not torch.equal(before[0], other) for other in before[1:])
    scan_layout.write_splits(
        root, {"train": ["zoe", "fay"], "validation": ["ann"], "test": ["cleo", "bob", "dan", "eve"]}
    )
    shutil.copytree(
        root / "subjects/bob", root / "subjects/zoe"
    )  # subjects with the same colours and the same texture are accepted
    assert torch.equal(build_encoder(root)(inputs), before)
    assert torch.equal(build_encoder(root)(inputs[[4, 1]].double()), before[[4, 1]].double())


@pytest.mark.parametrize("kind", [{}, {"textures": None}], ids=["texture", "colours"])
def test_meshes_are_drawn_on_the_cpu_wherever_the_model_is(root, kind):
    assert torch.equal(
        build_encoder(root, **kind).to("meta")(inputs_of(2)), build_encoder(root, **kind)(inputs_of(2))
    )


def test_a_stranger_is_refused_by_the_row(root):
    inputs = inputs_of(3)
    inputs[2, 7, 4] = (inputs[2, 7, 4] + 1 / 255) % 1
    with pytest.raises(
        DataError, match=r"Row 2 of the batch has the vertex colours of no subject in .*scans;"
    ):
        build_encoder(root)(inputs)


def test_extreme_vertices_leave_a_finite_picture(root):
    rasterised, inputs = build_encoder(root), inputs_of(1)
    for spoilt in (1e30, -1e30, 1e-30, 0.0, -5.0):
        inputs[0, :3, 2] = spoilt
        assert rasterised(inputs).isfinite().all()
    padded = torch.cat([inputs_of(1), torch.full((1, 3, 6), math.nan)], 1)
    assert torch.equal(rasterised(padded), rasterised(inputs_of(1)))


def change_arrays(**change):
    def spoil(root):
        arrays = dict(np.load(root / "topology_7k.npz"))
        np.savez(
            root / "topology_7k.npz", **{**arrays, **{key: to(arrays[key]) for key, to in change.items()}}
        )  # pyright: ignore

    return spoil


def write_equal_colors(root):
    for name in ("ann", "dan"):
        scan_layout.write_registration(root / f"subjects/{name}/registration_7k.ply", colored_mesh(2))


def remove_folder(root):
    shutil.rmtree(root)


FIRST = "subjects/ann/texture.png"
WRONG = {
    **{f"texture {kind}": ((lambda root, kind=kind: damage(root / FIRST, kind)), FIRST) for kind in DAMAGES},
    **{
        f"places {kind}": (
            (lambda root, kind=kind: damage(root / "topology_7k.npz", kind)),
            "topology_7k.npz",
        )
        for kind in DAMAGES
    },
    "another mesh's": (
        change_arrays(faces=lambda faces: faces[::-1]),
        "are not the 2 faces of the registered meshes",
    ),
    "fewer faces": (
        change_arrays(faces=lambda faces: faces[:1], uv_faces=lambda faces: faces[:1]),
        "the 1 faces in",
    ),
    "no such place": (change_arrays(uv_faces=lambda faces: faces + 1), "rows of uv in uv_faces"),
    "in space": (change_arrays(uv=lambda uv: np.pad(uv, ((0, 0), (0, 1)))), "topology_7k.npz"),
    "nowhere": (change_arrays(uv=lambda uv: uv * np.nan), "finite uv (coordinates, 2)"),
    "colours of another": (write_equal_colors, "have the same vertex colours"),
    "gone": (remove_folder, "no such folder"),
}


@pytest.mark.parametrize("spoil, words", WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said(root, spoil, words):
    rasterised = build_encoder(root)  # built before the fault, as in a model that is loaded later
    spoil(root)
    with pytest.raises(DataError) as caught:
        rasterised(inputs_of(1))
    message = " ".join(str(caught.value).split())
    assert words in message and str(root) in message


def test_what_lacks_textures_is_refused(root, monkeypatch):
    with pytest.raises(ConfigError, match="expected human_scans"):
        build_encoder(root, textures={"name": "registration"})
    renderer = type(build("renderer", resolve("renderer", "rasterizer")))
    monkeypatch.setattr(renderer, "channels", renderer.channels - {"uv"})
    with pytest.raises(ConfigError, match="does not draw the channels uv"):
        build_encoder(root)
    build_encoder(root, textures=None)
