"""Tests of soft images and their gradients, compared with the paper's formulas in torch and with differences."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from framework.geometry.camera import Camera
from framework.renderer import Scene
from plugins.renderer.rasterizer.canvas import Corners
from plugins.renderer.rasterizer.drawing import DrawingSettings, SceneArrays, backward, draw
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_gradient import blob, camera, rotate_by

SIZE = (11, 14)
KNOBS = ((1e-2, 0.05), (1e-3, 0.3), (0.2, 1e-3), (1e-5, 1e-4))


def autograd_image(vertices: Tensor, colors: Tensor, rotation: Tensor, translation: Tensor, lens: Tensor, faces:
Tensor,
              cull: bool, sigma: float, gamma: float) -> Tensor:  # fmt: skip
    """Return the image by the formulas in torch, for every pixel and face; all faces must be in view."""
    camera_points = vertices @ rotation.T + translation
    place = camera_points[:, :2] / camera_points[:, 2:] * lens[:2] + lens[2:]
    if cull:
        sides = place[faces][:, 1:] - place[faces][:, :1]
        faces = faces[torch.linalg.det(sides) < 0]
    corners, inverse = place[faces], 1 / camera_points[faces][..., 2]  # (faces, 3, 2), (faces, 3)
    row, column = torch.meshgrid(*(torch.arange(side).double() for side in SIZE), indexing="ij")
    pixel = torch.stack([column, row], -1)[:, :, None]  # (row, column, face, 2)
    start, end = corners, corners.roll(-1, 1)
    way = end - start
    from_one = pixel[..., None, :] - start
    part = ((from_one * way).sum(-1) / way.square().sum(-1)).clamp(0, 1)
    squared = (from_one - part[..., None] * way).square().sum(-1).amin(-1)
    homogeneous = torch.cat([corners, torch.ones_like(corners[..., :1])], -1)
    padded = torch.cat([pixel, torch.ones_like(pixel[..., :1])], -1)
    weights = torch.einsum(
        "rcfk,fkj->rcfj", padded.expand(*SIZE, len(faces), 3), torch.linalg.inv(homogeneous)
    )
    inside = (weights >= 0).all(-1)
    odds = torch.where(inside, 1.0, -1.0) * squared / sigma * (2 / min(SIZE)) ** 2
    coverage = odds.sigmoid()
    coverage = coverage.where(coverage >= 1e-4, 0)
    clipped = weights.clamp(min=0)
    clipped = clipped / clipped.sum(-1, keepdim=True)
    shares = clipped * inverse
    nearness = camera_points[faces][..., 2].min() * shares.sum(-1)
    shade = torch.einsum("rcfj,fjk->rcfk", shares / shares.sum(-1, keepdim=True), colors[faces])
    most = nearness.detach().where(coverage > 0, 1e-3).amax(2).clamp(min=1e-3)
    weight = coverage * ((nearness - most[..., None]).where(coverage > 0, 0) / gamma).exp()
    mean = (weight[..., None] * shade).sum(2) / (weight.sum(2) + ((1e-3 - most) / gamma).exp() + 1e-300)[
        ..., None
    ]
    return (1 - (1 - coverage).prod(2))[..., None] * mean


def random_inputs(seed: int) -> tuple[list[Tensor], Tensor]:
    """Return vertices, colours, rotation, translation, lens, float64, and faces.

    The faces overlap, share vertices and extend beyond the image.
    """
    torch.manual_seed(seed)
    vertices = torch.rand(9, 3).double() * torch.tensor([2.0, 1.6, 1]) - torch.tensor([1.0, 0.8, 0])
    faces = torch.cat([torch.arange(9).reshape(3, 3), torch.tensor([[2, 3, 7], [0, 4, 8], [1, 8, 5]])])
    rotation = rotate_by(torch.eye(3).double(), torch.tensor([0.1, -0.05, 0.2]).double())
    lens = torch.tensor([13.0, 12.5, 6.4, 5.1], dtype=torch.float64)
    return [
        vertices,
        torch.rand(9, 2).double(),
        rotation,
        torch.tensor([0.02, 0.03, 1.6]).double(),
        lens,
    ], faces


def soft_settings(faces: Tensor, cull: bool, sigma: float, gamma: float) -> DrawingSettings:
    return DrawingSettings(
        Corners(faces.numpy()),
        1e-3,
        SIZE,
        cull,
        ("color",),
        "soft",
        (sigma, gamma),
        frozenset(),
    )


def draw_soft(parts: list[np.ndarray], settings: DrawingSettings) -> np.ndarray:
    """Return the image in float64, before it is rounded."""
    rendered = draw(SceneArrays(*parts, None), settings, [], learning=True)
    assert rendered.soft_image is not None
    return rendered.soft_image.color


@pytest.mark.parametrize("knobs", KNOBS)
@pytest.mark.parametrize("cull", [False, True])
def test_image_and_gradients_equal_the_formulas(knobs: tuple[float, float], cull: bool) -> None:
    for seed in range(3):
        parts, faces = random_inputs(seed)
        copies = [part.clone().requires_grad_() for part in parts]
        wanted = autograd_image(*copies, faces, cull, *knobs)
        arrays = [part.numpy() for part in parts]
        settings = soft_settings(faces, cull, *knobs)
        rendered = draw(SceneArrays(*arrays, None), settings, [], learning=True)
        assert rendered.soft_image is not None
        np.testing.assert_allclose(rendered.soft_image.color, wanted.detach(), rtol=1e-9, atol=1e-12)
        slope = torch.randn(*SIZE, 2)
        (wanted * slope).sum().backward()
        gradients = backward(
            SceneArrays(*arrays, None), settings, rendered, None, {"color": slope.numpy()}, [True] * 6, False
        )
        for gradient, copy in zip(gradients[:5], copies, strict=True):
            assert copy.grad is not None and copy.grad.abs().max() > 0
            np.testing.assert_allclose(
                gradient, copy.grad, rtol=1e-7, atol=1e-8 * float(copy.grad.abs().max())
            )


@pytest.mark.parametrize("knobs", KNOBS)
def test_gradients_equal_differences_of_the_image(knobs: tuple[float, float]) -> None:
    """Compare gradients in every number of the scene with central differences, to 1e-4 of the largest gradient."""
    parts, faces = random_inputs(5)
    arrays, settings = [part.numpy() for part in parts], soft_settings(faces, False, *knobs)
    slope = np.random.default_rng(0).normal(size=(*SIZE, 2)).astype(np.float32)
    scene = SceneArrays(*arrays, None)
    rendered = draw(scene, settings, [], learning=True)
    gradients = backward(scene, settings, rendered, None, {"color": slope}, [True] * 6, False)[:5]
    step = 1e-6 if knobs[1] > 1e-4 else 1e-8
    for number, got in enumerate(gradients):
        assert got is not None
        wanted = np.zeros_like(got)
        for place in np.ndindex(got.shape):
            ends = []
            for sign in (1, -1):
                moved = [array.copy() for array in arrays]
                moved[number][place] += sign * step
                ends.append(float((draw_soft(moved, settings) * slope).sum()))
            wanted[place] = (ends[0] - ends[1]) / (2 * step)
        np.testing.assert_allclose(got, wanted, rtol=0, atol=1e-4 * np.abs(wanted).max())


def test_without_blur_the_soft_image_equals_the_hard_image() -> None:
    """Check pixels away from edges for small σ, and that the meaning of σ does not depend on the number of pixels."""
    vertices, faces, colors = blob(16)
    scene = Scene(vertices, faces, colors, camera())
    hard = Rasterizer()(scene, ("color", "depth", "face", "mask"))
    sharp = Rasterizer(gradient="soft", sigma=1e-8, gamma=1e-5)(scene, ("color", "depth", "face", "mask"))
    near = (hard["color"] - sharp["color"]).abs().amax(-1) < 1e-3
    assert near.float().mean() > 0.97 and hard["mask"].float().mean() > 0.1
    assert all(torch.equal(hard[name], sharp[name]) for name in ("depth", "face", "mask"))
    once, often = (
        Rasterizer(gradient="soft", sigma=1e-3, gamma=1e-3, supersampling=times)(scene)["color"]
        for times in (1, 3)
    )
    assert (once - often).abs().mean() < 0.01 < (once - hard["color"]).abs().mean()


def test_a_face_out_of_view_by_less_than_the_blur_is_visible() -> None:
    corners = torch.tensor([[-0.3, -0.3, 1.0], [-0.3, 0.3, 1], [-0.51, 0, 1]]) - torch.tensor([0.25, 0, 0])
    pose = Camera(torch.eye(3), torch.zeros(3), (20.0, 20.0), (9.5, 9.5), 20, 20)
    scene = Scene(corners, torch.tensor([[0, 1, 2]]), torch.ones(3, 1), pose)
    assert Rasterizer()(scene)["color"].sum() == 0
    blurred = Rasterizer(gradient="soft", sigma=1e-2)(scene)["color"]
    assert 0 < blurred.sum() < 20 and blurred[:, 10:].sum() == 0 and math.isfinite(blurred.sum())
