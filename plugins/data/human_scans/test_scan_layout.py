import json
import shutil
from itertools import permutations

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import default_collate

from framework.configuration.schema import build, resolve
from framework.datasets import scan_layout
from framework.errors import DataError
from framework.geometry.srgb import linear_from_srgb
from framework.testing.bodies import DOLL, colored_mesh, write_subjects
from framework.testing.data_folders import damage
from framework.testing.rows import DAMAGES
from plugins.data.human_scans.rows import SMALL

ONE = "subjects/ann"
FILES = (
    "test.txt",
    f"{ONE}/registration_7k.ply",
    f"{ONE}/cameras.json",
    f"{ONE}/images/near.png",
    f"{ONE}/masks/front.png",
)


def data(root, **config):
    return build("data", resolve("data", {"name": "human_scans", **SMALL, "root": str(root), **config}))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    root = tmp_path_factory.mktemp("scans")
    write_subjects(root)
    return root


@pytest.fixture
def root(whole, tmp_path):
    return shutil.copytree(whole, tmp_path / "root")


@pytest.mark.parametrize("kind", DAMAGES)
@pytest.mark.parametrize("file", FILES)
def test_damage_is_told_with_the_file(root, file, kind):
    if file == "test.txt" and kind == "cut":
        kind = "missing"  # half a list of names is still a valid list
    damage(root / file, kind)
    with pytest.raises(DataError, match=(root / file).name):
        data(root).prepare()


def camera(change):
    def spoil(root):
        file = root / ONE / "cameras.json"
        document = json.loads(file.read_text())
        change(document["views"])
        file.write_text(json.dumps(document))

    return spoil


def listed(name, text):
    return lambda root: (root / name).write_text(text)


def larger_mesh(root):
    more = colored_mesh(0)
    vertices = torch.cat([more.vertices, more.vertices[:1]])
    colors = torch.cat([more.colors, more.colors[:1]])
    mesh = scan_layout.RegisteredMesh(vertices, colors, more.faces)
    scan_layout.write_registration(root / "subjects/bob/registration_7k.ply", mesh)


def without(words):
    """Return a function that writes a registration as text without some of its lines."""

    def spoil(root):
        text = (
            "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n"
        )
        colors = "".join(f"property uchar {name}\n" for name in ("red", "green", "blue"))
        face = "element face 1\nproperty list uchar int vertex_indices\n"
        color, triangle = " 9 9 9", "3 0 1 2\n"
        if words == "colours":
            colors = color = ""
        else:
            face = triangle = ""
        rows = "".join(f"{x} {x * x} 1{color}\n" for x in range(3))
        file = root / ONE / "registration_7k.ply"
        file.write_text(text + colors + face + "end_header\n" + rows + triangle)

    return spoil


def resized(place):
    return lambda root: Image.new("L" if "masks" in place else "RGB", (9, 13)).save(
        root / ONE / f"{place}.png"
    )


WRONG = {
    "named twice": (camera(lambda views: views.append(views[0])), "view front occurs twice"),
    "no name": (camera(lambda views: views[0].pop("name")), "has no name"),
    "name of another folder": (camera(lambda views: views[0].update(name="../near")), "has no name"),
    "not a number": (camera(lambda views: views[0]["t"].__setitem__(1, float("nan"))), "finite"),
    "words": (
        camera(lambda views: views[0].update(R="north")),
        "R has the wrong shape or content; expected 3×3 finite",
    ),
    "too few": (
        camera(lambda views: views[0].update(K=[1, 2])),
        "K has the wrong shape or content; expected 3×3 finite",
    ),
    "mirrored": (camera(lambda views: views[0]["R"][0].__setitem__(0, -1.0)), "R is not a rotation"),
    "scaled": (camera(lambda views: views[0]["R"][0].__setitem__(0, 1.1)), "R is not a rotation"),
    "sheared": (camera(lambda views: views[0]["K"][0].__setitem__(1, 0.5)), "without shear"),
    "focal length": (camera(lambda views: views[0]["K"][1].__setitem__(1, -5)), "above 0"),
    "size": (camera(lambda views: views[0].update(height=0)), "whole numbers of pixels"),
    "no views": (camera(lambda views: views.clear()), "one camera or more"),
    "another size of all": (
        camera(lambda views: [view.update(height=13) for view in views]),
        "9 × 12 pixels",
    ),
    "another image": (resized("images/near"), "near.png: the image has 9 × 13 pixels"),
    "another mask": (resized("masks/near"), "near.png: the image has 9 × 13 pixels"),
    "a subject in two splits": (listed("test.txt", "eve\nbob\n"), "bob is already listed in train.txt"),
    "a subject twice": (listed("test.txt", "eve\neve\n"), "eve is already listed in test.txt"),
    "nobody": (listed("validation.txt", "\n"), "the list is empty"),
    "a path": (listed("test.txt", "../eve\n"), "cannot be the name of a folder"),
    "two in a line": (listed("test.txt", "eve\x0bzoe\n"), "cannot be the name of a folder"),
    "a stranger": (listed("test.txt", "zoe\n"), "no such folder; expected the files of the subject zoe"),
    "another mesh": (larger_mesh, "has 41 vertices, but that of"),
    "no colours": (without("colours"), "have no colours"),
    "no faces": (without("faces"), "has no faces"),
}


@pytest.mark.parametrize("spoil, words", WRONG.values(), ids=WRONG)
def test_what_is_wrong_is_said(root, spoil, words):
    spoil(root)
    with pytest.raises(DataError) as caught:
        data(root).prepare()
    assert words in " ".join(str(caught.value).split())


def test_images_of_two_sizes_are_refused(root):
    camera(lambda views: [view.update(height=13) for view in views])(root)
    for place in ("images/near", "masks/near", "images/front", "masks/front"):
        resized(place)(root)
    with pytest.raises(DataError, match="one size"):
        data(root).prepare()


def test_another_topology_is_named(whole):
    with pytest.raises(DataError, match=r"the folder has the topologies 7k\. Set data\.topology"):
        data(whole, topology="27k").prepare()


def test_what_is_written_is_read(tmp_path):
    mesh = colored_mesh(3)
    scan_layout.write_registration(tmp_path / "registration_7k.ply", mesh)
    mesh_read = scan_layout.read_registration(tmp_path / "registration_7k.ply")
    for name in ("vertices", "colors", "faces"):
        assert torch.equal(getattr(mesh_read, name), getattr(mesh, name))


def test_one_changed_pixel_changes_the_fingerprint(root):
    before = data(root)
    before.prepare()
    for kind, value in (("images", (1, 2, 3)), ("masks", 7)):
        file = root / ONE / kind / "near.png"
        image = Image.open(file)
        image.putpixel((4, 4), value)
        image.save(file)
        after = data(root)
        after.prepare()
        assert after.fingerprint()["sha256"] != before.fingerprint()["sha256"]
        before = after


def test_targets_are_photographs_put_on_white_in_light(whole):
    prepared = data(whole)
    prepared.prepare()
    sample = prepared.splits().train[3]  # bob's second view
    home = whole / "subjects/bob"
    stored = np.asarray(Image.open(home / "images/near.png")).astype(np.float64) / 255
    cover = np.asarray(Image.open(home / "masks/near.png")).astype(np.float64)[..., None] / 255
    # IEC 61966-2-1, both ways
    light = np.where(stored <= 0.04045, stored / 12.92, ((stored + 0.055) / 1.055) ** 2.4)
    light = light * cover + 1 - cover
    target = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    np.testing.assert_allclose(sample["color"].numpy(), light, atol=1e-6)
    np.testing.assert_allclose(sample["target"].numpy(), target, atol=1e-6)
    assert np.array_equal(sample["mask"].numpy(), cover[..., 0] >= 0.5)
    assert (int(sample["subject"]), int(sample["index"])) == (1, 3)
    assert prepared.target.size == (12, 9) and prepared.target.names == ("red", "green", "blue")


def test_inputs_keep_their_pixels_in_the_canonical_camera(whole):
    prepared = data(whole)
    prepared.prepare()
    view = json.loads((whole / "subjects/ann/cameras.json").read_text())["views"][1]
    matrix, rotation, shift = (np.array(view[key]) for key in ("K", "R", "t"))
    mesh = colored_mesh(0)
    projected = (matrix @ (rotation @ mesh.vertices.double().numpy().T + shift[:, None])).T
    inputs = prepared.splits().train[1]["input"].double().numpy()
    height, width = prepared.size
    pixel = height * inputs[:, :2] / inputs[:, 2:3] + [(width - 1) / 2, (height - 1) / 2]
    np.testing.assert_allclose(pixel, projected[:, :2] / projected[:, 2:], rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(inputs[:, 2], projected[:, 2], rtol=1e-6)
    np.testing.assert_allclose(inputs[:, 3:] * 255, mesh.colors.numpy(), atol=1e-4)


def test_own_meshes_are_seen_whole_or_by_their_own_cameras(whole, tmp_path):
    unprepared = build(
        "data", resolve("data", {"name": "human_scans", **SMALL, **DOLL, "height": 40, "width": 30})
    )
    random = np.random.default_rng(0)
    for number in range(20):
        mesh = colored_mesh(number)
        vertices = mesh.vertices * torch.from_numpy(10 ** random.uniform(-2, 1, 3)).float() + 5
        file = tmp_path / f"{number}.ply"
        scan_layout.write_registration(file, scan_layout.RegisteredMesh(vertices, mesh.colors, mesh.faces))
        inputs = unprepared.inputs(file)[0]
        pixel = 40 * inputs[:, :2] / inputs[:, 2:3] + torch.tensor([14.5, 19.5])
        assert (inputs[:, 2] > 0).all() and (pixel > 0).all() and (pixel < torch.tensor([29.0, 39.0])).all()
    beside = whole / "subjects/ann"
    assert unprepared.inputs(beside / "registration_7k.ply").shape == (2, 40, 6)


@pytest.mark.parametrize("shows", ["photograph", "subject"])
@pytest.mark.parametrize(("mirrored", "recoloured"), [(True, 0.0), (False, 1.0), (True, 0.5), (False, 0.0)])
def test_a_varied_batch_shows_what_a_photograph_of_the_varied_points_would(
    whole, mirrored, recoloured, shows
):
    """Check that mesh and photograph change alike, each sample in one of the twelve ways that the settings allow."""
    prepared = data(whole, mirrored=mirrored, recoloured=recoloured, shows=shows)
    prepared.prepare()
    train = prepared.splits().train
    batch = default_collate([train[number % len(train)] for number in range(120)])
    torch.manual_seed(0)
    augmented = prepared.augment(batch)
    height, width = prepared.size
    ways = set()
    for row in range(120):
        sign = augmented["input"][row, :, 0] / batch["input"][row, :, 0]
        assert torch.equal(sign, sign[:1].expand(len(sign))) and abs(float(sign[0])) == 1
        order = next(
            order
            for order in permutations(range(3))
            if torch.equal(
                batch["color"][row][..., list(order)].flip(1 if sign[0] < 0 else ()), augmented["color"][row]
            )
        )
        ways.add((float(sign[0]), order))
        assert torch.equal(augmented["input"][row, :, 3:], batch["input"][row, :, 3:][:, list(order)])
        turned = {
            key: batch[key][row].flip(1) if sign[0] < 0 else batch[key][row] for key in ("target", "mask")
        }
        target = turned["target"][..., list(order)] if shows == "photograph" else turned["target"]
        assert torch.equal(augmented["target"][row], target)
        assert torch.equal(augmented["mask"][row], turned["mask"])
        # pixels at which the canonical camera sees the points, mirrored about its middle column
        pixel = height * augmented["input"][row, :, 0] / augmented["input"][row, :, 2] + (width - 1) / 2
        before = height * batch["input"][row, :, 0] / batch["input"][row, :, 2] + (width - 1) / 2
        torch.testing.assert_close(pixel, before if sign[0] > 0 else width - 1 - before)
        assert torch.equal(augmented["input"][row, :, 1:3], batch["input"][row, :, 1:3])
    assert len(ways) == (2 if mirrored else 1) * (6 if recoloured else 1)
    assert prepared.varies == (mirrored or recoloured > 0)


def test_targets_are_silhouettes_where_who_is_where_is_asked(whole):
    silhouettes, photographs = (data(whole, shows=target_kind) for target_kind in ("subject", "photograph"))
    for data_set in (silhouettes, photographs):
        data_set.prepare()
    assert silhouettes.target.names == ("subject",) and silhouettes.target.event_shape == (12, 9, 1)
    assert silhouettes.fingerprint() != photographs.fingerprint() and "shows" not in photographs.fingerprint()
    for data_set, photograph in zip(silhouettes.splits().test, photographs.splits().test, strict=True):
        assert (
            torch.equal(data_set["target"][..., 0], photograph["mask"].float())
            and 0 < data_set["target"].mean() < 1
        )
        assert all(torch.equal(data_set[name], photograph[name]) for name in ("input", "color", "mask"))


def test_a_mesh_drawn_as_ground_leaves_free_what_its_picture_leaves_white():
    random = torch.Generator().manual_seed(0)
    cloud = torch.cat([torch.randn(1, 132, 3, generator=random) / 4, torch.zeros(1, 132, 3)], 2)
    cloud[..., 2] += 2
    config = {
        "name": "rasterised",
        **DOLL,
        "renderer": "rasterizer",
        "height": 24,
        "width": 20,
        "depth": True,
    }
    rendered, ground = (
        build(
            "encoder",
            resolve("encoder", {**config, "ground": ground}),
            input_shape=(132, 6),
            input_columns=(),
        )(cloud)
        for ground in (False, True)
    )
    assert rendered.shape == (1, 4, 24, 20) and ground.shape == (1, 2, 24, 20)
    # vertices are black, so that all remaining light is the white background
    torch.testing.assert_close(linear_from_srgb(rendered[:, :1]), ground[:, :1], atol=1e-5, rtol=0)
    assert torch.equal(rendered[:, 3], ground[:, 1]) and 0 < float(ground[:, 0].mean()) < 1
