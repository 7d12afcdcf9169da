from dataclasses import replace

import pytest
import torch

import framework
from framework.configuration.schema import build, resolve
from framework.distributions.protocol import images
from framework.errors import CheckpointError, ConfigError
from framework.geometry.camera import canonical_camera, look_from
from framework.geometry.srgb import linear_from_srgb, srgb_from_linear
from framework.renderer import Scene
from framework.testing.scenes import sphere
from plugins.renderer.smplpix.renderer import LARGEST_CHANGE
from plugins.renderer.smplpix.rows import NEAR, SLIM, UNET, projection_settings, write_checkpoint

SIZE, OTHER = (40, 32), (27, 50)
MESH = sphere(rings=12)
ENCODERS = {
    "projection, slim": [projection_settings(SIZE, **NEAR), {"name": "slim", **SLIM}],
    "projection, unet": [projection_settings(SIZE, levels=2, **NEAR), {"name": "unet", **UNET}],
    "rasterised, slim": [
        projection_settings(SIZE, "rasterised", depth=True),
        {"name": "slim", **SLIM, "residual": True},
    ],
}


def renderer(run, **config):
    settings = {"name": "smplpix", "checkpoint": str(run), "precision": "trained", **config}
    return build("renderer", resolve("renderer", settings))


def own_paths(encoders):
    """Return the paths that the user must repeat, because stored paths of a checkpoint are not used otherwise."""
    return {"encoder.rasterised.root": encoders[0]["root"]} if "root" in encoders[0] else {}


def distant_camera(size, azimuth=0.4):
    """Return a camera with unequal focal lengths and an off-centre principal point, unlike a canonical camera."""
    camera = look_from(azimuth, 0.3, -0.2, distance=3.5, field_of_view=0.8, size=size)
    return replace(camera, focal=(camera.focal[0], 1.1 * camera.focal[1]), principal=(17.0, 15.5))


@pytest.fixture(scope="module", params=ENCODERS)
def encoders(request, tmp_path_factory):
    settings = [dict(part) for part in ENCODERS[request.param]]
    if settings[0]["name"] == "rasterised":
        settings[0]["root"] = str(write_registration(tmp_path_factory.mktemp("root")))
    return settings


def write_registration(folder):
    """Write a sphere as registration in the folder layout that the encoder `rasterised` reads."""
    for split in ("train", "validation", "test"):
        (folder / f"{split}.txt").write_text(f"{split}\n")
    file = folder / "subjects/train/registration_7k.ply"
    file.parent.mkdir(parents=True)
    numbers = ("float x", "float y", "float z", "uchar red", "uchar green", "uchar blue")
    head = ["ply", "format ascii 1.0", f"element vertex {len(MESH.vertices)}"]
    head += [*(f"property {number}" for number in numbers), f"element face {len(MESH.faces)}"]
    lines = [" ".join([*map(str, place), "9 9 9"]) for place in MESH.vertices.tolist()]
    lines += [" ".join(map(str, (3, *corners))) for corners in MESH.faces.tolist()]
    file.write_text("\n".join([*head, "property list uchar int vertex_indices", "end_header", *lines, ""]))
    return folder


def network_input(scene):
    """Return the input of the network for a scene."""
    assert scene.colors is not None
    return torch.cat([scene.camera.to_canonical(scene.vertices), srgb_from_linear(scene.colors)], 1)[None]


@pytest.mark.parametrize("size", [SIZE, OTHER])
@pytest.mark.parametrize("members", [1, 3])
def test_the_image_equals_the_prediction_of_the_loaded_run(encoders, size, members, tmp_path):
    wrapped = {"uncertainty": [{"name": "ensemble", "members": members}]} if members > 1 else {}
    points = len(MESH.vertices)
    paths = own_paths(encoders)
    smplpix = renderer(
        write_checkpoint(tmp_path / "run.ckpt", encoders, SIZE, points, **wrapped), paths=paths
    )
    sized = [{**encoders[0], "height": size[0], "width": size[1]}, encoders[1]]
    loaded = framework.load(
        write_checkpoint(tmp_path / "sized.ckpt", sized, size, points, **wrapped), paths=paths
    )
    for azimuth in (0.4, 2.0):
        scene = replace(MESH, camera=distant_camera(size, azimuth))
        before = torch.random.get_rng_state()
        image = smplpix(scene)["color"]
        assert torch.equal(torch.random.get_rng_state(), before)
        with torch.no_grad():
            density = loaded(network_input(scene))
        assert torch.equal(image, images(density, ("color",))["color"][0])
        if members == 1:
            assert torch.equal(image, linear_from_srgb(density.mean[0]))  # the predicted sRGB as linear RGB
        assert image.max() - image.min() > 0.01 and image.shape == (*size, 3)


def test_any_camera_gives_the_image_of_the_canonical_camera(tmp_path):
    smplpix = renderer(write_checkpoint(tmp_path / "run.ckpt", ENCODERS["projection, slim"], SIZE))
    scene = replace(MESH, vertices=MESH.vertices.double(), camera=distant_camera(SIZE))
    pixels, depth = scene.camera.project(scene.vertices)
    clear = ((pixels + 0.5) - (pixels + 0.5).round()).abs().amin(
        1
    ) > 1e-3  # so that rounding does not change a pixel
    plain = canonical_camera(*SIZE)
    across = (pixels - torch.tensor(plain.principal)) / torch.tensor(plain.focal)
    moved = torch.cat([across, torch.ones(len(pixels), 1)], 1) * depth[:, None]
    some = {"faces": MESH.faces[:0], "colors": MESH.colors[clear]}
    image = smplpix(replace(scene, vertices=scene.vertices[clear], **some))["color"]
    canonical_image = smplpix(replace(scene, vertices=moved[clear], camera=plain, **some))["color"]
    torch.testing.assert_close(image, canonical_image, rtol=0, atol=1e-5)


def test_invisible_vertices_have_no_effect(tmp_path):
    smplpix = renderer(write_checkpoint(tmp_path / "run.ckpt", ENCODERS["projection, slim"], SIZE))
    scene = replace(MESH, camera=replace(distant_camera(SIZE), near=3.0))
    assert scene.colors is not None
    _, depth = scene.camera.project(scene.vertices)
    vertices, bad = scene.vertices.clone(), torch.arange(len(depth)) % 7 == 0
    vertices[bad] = torch.tensor([torch.nan, torch.inf, 0.0])
    good = (depth >= 3.0) & ~bad
    assert 0 < good.sum() < len(depth)
    alone = Scene(vertices[good], MESH.faces[:0], scene.colors[good], scene.camera)
    assert torch.equal(smplpix(replace(scene, vertices=vertices))["color"], smplpix(alone)["color"])


def test_the_box_and_the_precision_can_be_chosen(tmp_path):
    run = write_checkpoint(
        tmp_path / "run.ckpt", [ENCODERS["projection, slim"][0], {"name": "slim", **SLIM, "crop": 0}], SIZE
    )
    scene = replace(MESH, camera=distant_camera(SIZE))
    pictures = [
        renderer(run, **config)(scene)["color"]
        for config in ({}, {"crop": 0}, {"crop": "whole"}, {"precision": "bfloat16"})
    ]
    assert torch.equal(pictures[0], pictures[1])
    for other in pictures[2:]:
        assert 0 < (other - pictures[0]).abs().max() < 0.5


@pytest.mark.parametrize("accepted", [LARGEST_CHANGE, 0.0])
def test_bfloat16_is_the_default_only_where_it_is_accurate(accepted, encoders, tmp_path, monkeypatch):
    monkeypatch.setattr("plugins.renderer.smplpix.renderer.LARGEST_CHANGE", accepted)
    run = write_checkpoint(tmp_path / "run.ckpt", encoders, SIZE, len(MESH.vertices))
    scene = replace(MESH, camera=distant_camera(SIZE))
    automatic, exact, fast = (
        renderer(run, paths=own_paths(encoders), precision=precision)(scene)["color"]
        for precision in ("auto", "float32", "bfloat16")
    )
    assert not torch.equal(exact, fast)
    has_bfloat16 = torch.cpu._is_avx512_bf16_supported() or torch.cpu._is_amx_tile_supported()
    assert torch.equal(automatic, fast if has_bfloat16 and accepted > 0 else exact)


@pytest.mark.parametrize("run, kind, message", [
    (None, ConfigError, "experiment=smplpix/quick"),
    ("/nowhere/at/all", CheckpointError, "neither a file"),
])  # fmt: skip
def test_a_missing_run_raises_a_clear_message(run, kind, message):
    with pytest.raises(kind, match=message):
        build("renderer", resolve("renderer", {"name": "smplpix", "checkpoint": run}))


def test_stored_paths_must_be_repeated(encoders, tmp_path):
    run = write_checkpoint(tmp_path / "run.ckpt", encoders, SIZE, len(MESH.vertices))
    for key, path in own_paths(encoders).items():
        with pytest.raises(ConfigError, match=r"encoder\.rasterised\.root="):
            renderer(run)
        assert key == "encoder.rasterised.root"
        renderer(run, paths={"encoder": {"rasterised": {"root": path}}})  # nested, as on a command line


def test_scenes_that_do_not_fit_raise_an_error(encoders, tmp_path):
    run = write_checkpoint(tmp_path / "run.ckpt", encoders, SIZE, len(MESH.vertices))
    smplpix = renderer(run, paths=own_paths(encoders))
    scene = replace(MESH, camera=distant_camera(SIZE))
    assert scene.colors is not None
    with pytest.raises(ValueError, match="red, green and blue"):
        smplpix(replace(scene, colors=scene.colors[:, :1]))
    for name in ("focal", "principal"):
        for lens in (8.0, (8.0,), (8.0, 8.0, 8.0), torch.tensor([8.0]), torch.tensor(8.0), torch.ones(2, 1)):
            camera = distant_camera(SIZE)
            object.__setattr__(camera, name, lens)  # bypasses the type checks of the tests
            with pytest.raises(ValueError, match=rf"camera\.{name} has .*; expected the shape \(2,\)"):
                smplpix(replace(scene, camera=camera))
    if encoders[0]["name"] == "rasterised":
        with pytest.raises(ValueError, match="topology"):
            smplpix(replace(scene, vertices=MESH.vertices[:9], colors=scene.colors[:9], faces=MESH.faces[:0]))


def test_a_run_that_does_not_predict_rgb_raises_an_error(tmp_path):
    grey = write_checkpoint(
        tmp_path / "grey.ckpt",
        [projection_settings(SIZE, **NEAR), {"name": "slim", **SLIM, "colors": 1}],
        SIZE,
        names=("grey",),
    )
    with pytest.raises(ConfigError, match=r"predicts grey from x, y, z.*red, green and blue"):
        renderer(grey)
