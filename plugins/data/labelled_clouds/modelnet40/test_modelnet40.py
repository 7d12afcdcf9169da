"""The reader of the official layout, the generated set, and the data contract."""

import hashlib
import json
import math

import numpy as np
import pytest
import torch

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError
from framework.geometry.meshes import READERS, Mesh, normals, read, sample, stream
from plugins.data.labelled_clouds.modelnet40 import generator, solids
from plugins.data.labelled_clouds.modelnet40.generator import CLASSES, as_off, generated, model

SIZES = {"train_models": 4, "test_models": 2}


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    """A generated root of 4 + 2 models a class; its cache too is the module's own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FRAMEWORK_CACHE", str(tmp_path_factory.mktemp("cache")))
        return generated(4, 2, 0)


@pytest.fixture
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("FRAMEWORK_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def data(**config):
    return build("data", resolve("data", {"name": "modelnet40", **config}))


def prepared(**config):
    found = data(**config)
    found.prepare()
    return found


def cube(folder, *names, size=1.0, content=None):
    """Cubes as `<folder>/<name>`, the official way to break a header included."""
    text = as_off(solids.box(size, size, size)).replace("OFF\n", "OFF", 1)
    for name in names:
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text if content is None else content)


def official(folder):
    for category in ("cube", "crate", "box"):
        cube(folder, *(f"{category}/train/{category}_{number:04d}.off" for number in range(5)))
        cube(folder, *(f"{category}/test/{category}_{number:04d}.off" for number in range(5, 7)))
    return folder


def test_splits_labels_and_attributes(cache, tmp_path):
    root = official(tmp_path / "ModelNet40")
    clouds = prepared(root=str(root), points=64, validation_share=0.2)
    assert clouds.target.kind == "class"
    assert clouds.target.names == ("box", "crate", "cube")
    assert clouds.input_shape == (64, 3)
    assert clouds.columns == ("x", "y", "z")
    assert (clouds.synthetic, clouds.skipped, clouds.varies) == (False, 0, False)
    sizes = {}
    for name, split in (
        ("train", clouds.train()),
        ("validation", clouds.validation()),
        ("test", clouds.test()),
    ):
        batch = split.__getitems__(range(len(split)))
        sizes[name] = torch.bincount(batch["target"]).tolist()
        assert batch["input"].shape == (len(split), 64, 3)
        assert batch["input"].dtype == torch.float32
        assert batch["index"].tolist() == list(range(len(split)))
        assert not batch["group"].any()
        surface = (batch["input"] - torch.tensor([0, 0, 0.5])).abs().amax(-1)
        torch.testing.assert_close(surface, torch.full_like(surface, 0.5))
        assert clouds.augment(batch) is batch
    assert sizes == {"train": [4, 4, 4], "validation": [1, 1, 1], "test": [2, 2, 2]}
    print_of = clouds.fingerprint()
    assert (print_of["train"], print_of["version"]) == ("12", "ModelNet40")


def test_points_are_those_of_the_file_whatever_else_is_read(cache, tmp_path):
    root = official(tmp_path / "ModelNet40")
    file = root / "cube" / "test" / "cube_0006.off"
    wanted = sample(read(file), 64, stream(7, "cube_0006.off")).points.astype(np.float32)
    for config in ({}, {"classes": ["cube", "box"]}):
        clouds = prepared(root=str(root), points=64, data_seed=7, **config)
        last = clouds.test()[len(clouds.test()) - 1]
        np.testing.assert_array_equal(last["input"], wanted)
    unlabelled = data(points=64, data_seed=7).read([file])  # without prepare
    np.testing.assert_array_equal(unlabelled[0]["input"], wanted)
    assert set(unlabelled[0]) == {"input", "index"}


def test_the_second_run_reads_no_mesh(cache, tmp_path, monkeypatch):
    root = official(tmp_path / "ModelNet40")
    first = prepared(root=str(root), points=32)
    monkeypatch.setitem(READERS, ".off", None)
    again = prepared(root=str(root), points=32)
    assert torch.equal(
        first.train().__getitems__([3, 1])["input"], again.train().__getitems__([3, 1])["input"]
    )
    assert first.fingerprint() == again.fingerprint()


def test_normals_are_those_of_the_faces(cache, tmp_path):
    clouds = prepared(root=str(official(tmp_path / "ModelNet40")), points=50, normals=True)
    assert clouds.columns == ("x", "y", "z", "normal_x", "normal_y", "normal_z")
    assert clouds.input_shape == (50, 6)
    found = clouds.train().__getitems__(range(len(clouds.train())))["input"]
    # a cube's normal is along the coordinate that is furthest from its middle, outwards
    local = found[..., :3] - torch.tensor([0, 0, 0.5])
    at = local.abs().argmax(-1, keepdim=True)
    outwards = torch.zeros_like(local).scatter(-1, at, local.gather(-1, at).sign())
    torch.testing.assert_close(found[..., 3:], outwards, atol=1e-6, rtol=0)


def test_rotations_repeat_the_training_split_about_the_up_axis(cache, tmp_path):
    config = {"root": str(official(tmp_path / "ModelNet40")), "points": 40, "normals": True}
    plain, turned = prepared(**config), prepared(**config, rotations=3)
    count = len(plain.train())
    assert len(turned.train()) == 3 * count
    assert len(turned.test()) == len(plain.test())
    one = plain.train().__getitems__(range(count))
    all_three = turned.train().__getitems__(range(3 * count))
    torch.testing.assert_close(all_three["input"][:count], one["input"], atol=0, rtol=0)
    assert all_three["index"].tolist() == list(range(3 * count))
    assert all_three["target"].tolist() == 3 * one["target"].tolist()
    for turn in (1, 2):
        found = all_three["input"][turn * count : (turn + 1) * count]
        for first in (0, 3):  # as complex numbers: a factor of exp(2πi turn / 3)
            before = torch.complex(one["input"][..., first].double(), one["input"][..., first + 1].double())
            after = torch.complex(found[..., first].double(), found[..., first + 1].double())
            factor = complex(math.cos(2 * math.pi * turn / 3), math.sin(2 * math.pi * turn / 3))
            torch.testing.assert_close(after, before * factor, atol=1e-6, rtol=0)
        torch.testing.assert_close(found[..., [2, 5]], one["input"][..., [2, 5]], atol=0, rtol=0)
    single = turned.train()[count + 2]
    assert torch.equal(single["input"], all_three["input"][count + 2])
    with pytest.raises(IndexError):
        turned.train()[3 * count]


def test_what_cannot_be_read_is_refused_or_skipped_and_counted(cache, tmp_path):
    root = official(tmp_path / "ModelNet40")
    cube(root, "cube/train/cube_0001.off", content="OFF\n3 0 0\n0 0 0\n1 0 0\n0 1 0\n")
    cube(root, "box/test/box_0005.off", content="OFF 1\n")
    with pytest.raises(
        DataError, match=r"(?s)2 of 21 samples cannot.*it has no faces.*data\.unreadable=skip"
    ):
        prepared(root=str(root))
    clouds = prepared(root=str(root), unreadable="skip", validation_share=0.2)
    assert clouds.skipped == 2
    assert torch.bincount(clouds.test().fields.fields["target"]).tolist() == [1, 2, 2]
    assert len(clouds.train()) + len(clouds.validation()) == 14


def test_other_layouts_and_classes_are_refused(cache, tmp_path):
    root = official(tmp_path / "ModelNet40")
    with pytest.raises(DataError, match="no such folder"):
        prepared(root=str(tmp_path / "elsewhere"))
    with pytest.raises(DataError, match="ModelNet40 has no folders train and test"):
        prepared(root=str(tmp_path))
    with pytest.raises(DataError, match=r"names 'crat', which .* Did you mean 'crate'"):
        prepared(root=str(root), classes=["crat", "box"])
    with pytest.raises(DataError, match="wanted at least two of box, crate, cube"):
        prepared(root=str(root), classes=["box"])
    for file in (root / "crate" / "test").iterdir():
        file.unlink()
    with pytest.raises(DataError, match=r"crate/test holds no \.off file"):
        prepared(root=str(root))


@pytest.mark.parametrize(
    "config", [{"points": 0}, {"rotations": 0}, {"validation_share": 1.0}, {"unreadable": "no"}]
)
def test_a_config_out_of_range_is_refused(config):
    with pytest.raises(ConfigError, match=r"data\."):
        resolve("data", {"name": "modelnet40", **config})


# ---- the generated set -----------------------------------------------------------------------------------


def test_without_a_root_a_marked_set_is_read(cache):
    clouds = prepared(points=128, **SIZES)
    assert clouds.synthetic
    assert len(clouds.target.names) == len(CLASSES) >= 16
    assert clouds.fingerprint()["root"] == "synthetic, seed 0"
    assert torch.bincount(clouds.test().fields.fields["target"]).tolist() == [2] * len(CLASSES)
    image = clouds.picture(clouds.test()[0]["input"])
    assert image.shape == (160, 160, 3)
    assert 0.02 < (image < 255).any(-1).mean() < 0.9


def test_a_root_is_a_function_of_its_seed_to_the_byte(root, cache):
    again = generated(4, 2, 0)
    assert again != root

    def content(folder):
        return {file.relative_to(folder): file.read_bytes() for file in sorted(folder.rglob("*.off"))}

    assert content(again) == content(root)
    more = content(generated(5, 2, 0))
    first = {name: text for name, text in content(root).items() if name.parts[1] == "train"}
    assert {name: more[name] for name in first} == first  # the first of more are those of fewer
    assert content(generated(4, 2, 1)) != content(root)
    assert json.loads((again / "synthetic.json").read_text())["seed"] == 0


def test_the_bytes_are_those_of_this_version():
    """Whoever changes a family or the writer also raises `generator.VERSION`, or old caches go on being read."""
    digest = hashlib.sha256()
    for category in CLASSES:
        digest.update(as_off(model(category, "train", 0, 0)).encode())
    assert (generator.VERSION, digest.hexdigest()[:12]) == (1, "ba0375fadc32")


@pytest.mark.parametrize("category", CLASSES)
def test_every_model_is_a_closed_surface_of_sensible_size(root, category):
    files = sorted((root / category).rglob("*.off"))
    assert [file.name for file in files] == [f"{category}_{number:04d}.off" for number in (5, 6, 1, 2, 3, 4)]
    for file in files:
        mesh = read(file)
        low, high = mesh.vertices.min(0), mesh.vertices.max(0)
        assert 0.05 < (high - low).max() < 6
        assert (high - low).min() > 0.01 * (high - low).max()
        assert 20 <= len(mesh.faces) < 8000
        # closed, and outwards on the whole: ∮ n dA = 0, and the volume ∮ x · n dA / 3 is positive
        corners = mesh.vertices[mesh.faces]
        area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
        np.testing.assert_allclose(area.sum(0), 0, atol=1e-4 * np.abs(area).sum())
        assert (corners.mean(1) * area).sum() / 3 > 0


def test_the_models_of_a_class_differ(root):
    for category in CLASSES:
        texts = {as_off(model(category, "train", number, 0)) for number in range(10)}
        assert len(texts) == 10


# ---- solids against their own formulas -------------------------------------------------------------------


def volume_and_area(solid):
    corners = solid.vertices[solid.faces]
    area = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2
    return (corners.mean(1) * area).sum() / 3, np.linalg.norm(area, axis=1).sum()


ANGLE = np.arange(400) * math.pi / 200
CIRCLE = np.stack([np.cos(ANGLE), np.sin(ANGLE)], 1)
SOLIDS = {
    "box": (solids.box(2.0, 3.0, 4.0, (5, 5, 5)), 24, 52),
    "frustum of a pyramid": (solids.tapered(2.0, 2.0, 1.0, 1.0, 3.0), 7, 5 + 4 * 1.5 * math.hypot(3, 0.5)),
    "cylinder": (solids.cylinder(0.5, 2.0, sides=400), math.pi / 2, 2.5 * math.pi),
    "cone": (solids.cylinder(1.0, 2.0, top=0.0, sides=400), 2 * math.pi / 3, math.pi * (1 + math.sqrt(5))),
    "ball": (solids.ball(1.0, (1, 2, 3), 400), 4 * math.pi / 3, 4 * math.pi),
    "rod": (solids.rod((1, 1, 1), (3, 3, 2), 0.1, 400), 3 * math.pi * 0.01, None),
    "plate": (solids.slab([(0, 0), (2, 0), (0, 2)], 0.5), 1, None),
    "washer": (solids.extruded(CIRCLE, 0.5, CIRCLE / 2), 0.375 * math.pi, 3 * math.pi),
}  # fmt: skip


@pytest.mark.parametrize("solid, volume, area", SOLIDS.values(), ids=SOLIDS)
def test_solids_have_their_volume_and_area(solid, volume, area):
    found = volume_and_area(solid)
    assert found[0] == pytest.approx(volume, rel=5e-4)
    if area is not None:
        assert found[1] == pytest.approx(area, rel=5e-4)


def test_a_ring_is_a_torus_and_its_normals_point_outwards():
    found, area = volume_and_area(solids.ring(1.0, 0.25, sides=400))
    # its tube has eight sides: the octagon's share of the disc, and of the circle
    assert found == pytest.approx(2 * math.pi * 0.25**2 * 4 * math.sin(math.pi / 4), rel=2e-3)
    assert area == pytest.approx(2 * math.pi * 16 * 0.25 * math.sin(math.pi / 8), rel=2e-3)


def test_mirror_images_and_turns_keep_the_outside_out():
    cone = solids.cylinder(0.3, 1.0, top=0.1).moved(1.0)
    whole = solids.mirrored(cone.turned("x", 30.0).turned("y", 40.0).turned("z", 50.0), 0)
    assert volume_and_area(whole)[0] == pytest.approx(2 * volume_and_area(cone)[0])
    mesh = Mesh("both", whole.vertices, whole.faces)
    assert np.isfinite(normals(mesh)).all()
