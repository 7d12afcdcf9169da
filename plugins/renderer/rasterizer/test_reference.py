"""Tests that compare the compiled kernels with the implementation in plain torch, which draws on a GPU."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from framework.renderer import Scene
from plugins.renderer.rasterizer import reference
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_gradient import blob
from plugins.renderer.rasterizer.test_savings import EVERY, distant_camera, random_bodies

EXACT = ("face", "mask", "normal")
"""Channels that are the same to the last bit."""


@settings(deadline=None, max_examples=25, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.booleans(), st.sampled_from([1, 3]))
def test_images_equal_those_of_plain_torch(seed: int, cull: bool, supersampling: int) -> None:
    """Compare scenes without faces that the near plane cuts, because plain torch leaves these out."""
    random = np.random.default_rng(seed)
    scene = random_bodies(distant_camera(float(random.uniform(5, 9)), (40, 50)), random)
    _, depth = scene.camera.project(scene.vertices)
    scene = replace(scene, camera=replace(scene.camera, near=min(1e-3, float(depth[depth > 0].min()))))
    whole = (depth[scene.faces] > 0).all(1)
    cover = scene.texture
    if cover is not None and cover.shown is not None:
        cover = replace(cover, faces=cover.faces[whole], shown=cover.shown[whole])
    scene = replace(scene, faces=scene.faces[whole], texture=cover)
    renderer = Rasterizer(cull=cull, supersampling=supersampling)
    compiled, plain = renderer(scene, EVERY), renderer.on_device(scene, EVERY)
    for name in EXACT:
        assert torch.equal(compiled[name], plain[name]), name
    for name in ("color", "depth", "barycentric", "uv"):
        torch.testing.assert_close(compiled[name], plain[name], rtol=1e-5, atol=1e-5)


def test_drawing_in_groups_equals_drawing_all_faces_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = random_bodies(distant_camera(), np.random.default_rng(3))
    whole = Rasterizer().on_device(scene, EVERY)
    monkeypatch.setattr(reference, "PAIRS", 500)
    parts = Rasterizer().on_device(scene, EVERY)
    assert all(torch.equal(whole[name], parts[name]) for name in EVERY)


def test_gradients_within_faces_equal_those_of_plain_torch() -> None:
    vertices, faces, colors = blob(12)
    scene = Scene(vertices, faces, colors, distant_camera())
    renderer = Rasterizer(gradient="interior")
    gradients = []
    for draw in (renderer, renderer.on_device):
        learned = [part.clone().requires_grad_() for part in (vertices, colors)]
        picture = draw(replace(scene, vertices=learned[0], colors=learned[1]), ("color",))["color"]
        gradients.append(torch.autograd.grad(picture.square().sum(), learned))
    for compiled, reference_gradient in zip(*gradients, strict=True):
        assert (compiled - reference_gradient).norm() < 0.01 * reference_gradient.norm()


@pytest.mark.parametrize("name", EVERY)
def test_empty_scenes_are_background(name: str) -> None:
    vertices, faces, colors = blob(4)
    for scene in (
        Scene(vertices, faces[:0], colors, distant_camera()),
        Scene(vertices[:0], faces[:0], colors[:0], distant_camera()),
        Scene(vertices + 100, faces, colors, distant_camera()),
    ):
        renderer = Rasterizer()
        assert torch.equal(renderer.on_device(scene, (name,))[name], renderer(scene, (name,))[name])


def test_features_that_plain_torch_lacks_raise_an_error() -> None:
    vertices, faces, colors = blob(4)
    scene = Scene(vertices, faces, colors, distant_camera())
    with pytest.raises(ValueError, match="Choose gradient=interior, or move the scene to the CPU"):
        Rasterizer().on_device(replace(scene, vertices=vertices.clone().requires_grad_()), ("color",))
    with pytest.raises(ValueError, match="gradient=soft draws only on the CPU"):
        Rasterizer(gradient="soft").on_device(scene, ("color",))
    with pytest.raises(ValueError, match="expected 0 to"):
        Rasterizer().on_device(replace(scene, faces=faces + 1000), ("mask",))
    with pytest.raises(ValueError, match="is on meta, but vertices are on cpu"):
        Rasterizer().on_device(replace(scene, colors=colors.to("meta")), ("mask",))
    with pytest.raises(ValueError, match="requires a scene with colours"):
        Rasterizer().on_device(replace(scene, colors=None), ("color",))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU, which is never required")
def test_a_scene_on_a_gpu_is_drawn_there() -> None:
    scene = random_bodies(distant_camera(), np.random.default_rng(1), 1)
    camera = replace(
        scene.camera, rotation=scene.camera.rotation.cuda(), translation=scene.camera.translation.cuda()
    )
    assert scene.colors is not None
    moved = Scene(scene.vertices.cuda(), scene.faces.cuda(), scene.colors.cuda(), camera)
    channels = Rasterizer()(moved, ("color", "face"))
    assert channels["color"].is_cuda
    assert (channels["face"].cpu() != Rasterizer()(scene, ("face",))["face"]).float().mean() < 1e-3
