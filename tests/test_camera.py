"""Projections of points by a camera, compared with OpenCV's documented formula and kornia's camera."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from kornia.geometry.camera import PinholeCamera

from framework.geometry.camera import Camera, canonical_camera, focal_length, look_from
from framework.geometry.rotation import viewpoint_rotation


def test_points_are_seen_where_opencv_and_kornia_say() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    for azimuth in (-2.0, 0.3, 2.5):
        seen = look_from(azimuth, 0.4, -0.2, distance=6.0, field_of_view=0.8, size=(48, 64))
        pixels, depth = seen.project(points)
        # docs.opencv.org, calib3d: s (u, v, 1) = K (R | t) (X, Y, Z, 1), x right, y down, z forward
        lens = np.array(
            [[seen.focal[0], 0, seen.principal[0]], [0, seen.focal[1], seen.principal[1]], [0, 0, 1]]
        )
        pose = np.concatenate([seen.rotation.double().numpy(), seen.translation.double().numpy()[:, None]], 1)
        homogeneous = lens @ pose @ np.concatenate([points.numpy(), np.ones((50, 1))], 1).T
        np.testing.assert_allclose(pixels.numpy(), (homogeneous[:2] / homogeneous[2]).T, rtol=1e-12)
        np.testing.assert_allclose(depth.numpy(), homogeneous[2], rtol=1e-12)
        inside, outside = torch.eye(4, dtype=torch.float64)[None], torch.eye(4, dtype=torch.float64)[None]
        inside[0, :3, :3], outside[0, :3] = torch.from_numpy(lens), torch.from_numpy(pose)
        theirs = PinholeCamera(inside, outside, torch.tensor([48.0]), torch.tensor([64.0])).project(points)
        torch.testing.assert_close(pixels, theirs, rtol=1e-9, atol=1e-9)


def test_the_lens_may_be_learned() -> None:
    focal = torch.tensor([50.0, 60.0], requires_grad=True)
    seen = Camera(torch.eye(3), torch.tensor([0.0, 0, 2]), focal, (10.0, 12.0), 24, 20)
    pixels, _ = seen.project(torch.tensor([[0.5, 0.25, 0.0]]))
    pixels.sum().backward()
    assert focal.grad is not None
    assert focal.grad.tolist() == [0.25, 0.125]
    assert math.isclose(float(pixels.detach()[0, 0]), 10 + 50 * 0.25)


def test_canonical_points_are_seen_at_the_same_pixels_and_depths() -> None:
    generator = torch.Generator().manual_seed(0)

    def some(*shape: int) -> torch.Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    for _ in range(50):
        height, width = (int(side) for side in 1 + 500 * some(2))
        focal, principal = 10 + 2000 * some(2), 1500 * some(2) - 500  # not even in the image
        if some(1) < 0.5:
            focal, principal = tuple(focal.tolist()), tuple(principal.tolist())
        camera = Camera(viewpoint_rotation(6 * some(3) - 3), 8 * some(3) - 4, focal, principal, height, width)
        points = 6 * some(4, 9, 3) - 3
        pixels, depth = camera.project(points)
        plain = canonical_camera(height, width)
        found = camera.to_canonical(points)
        again, same = plain.project(found)
        assert torch.equal(found[..., 2], depth) and torch.equal(same, depth)  # behind the camera, too
        torch.testing.assert_close(again, pixels, rtol=1e-9, atol=1e-9)
        # the canonical camera's own points stay where they are, and its pixels are those that its docstring says
        torch.testing.assert_close(plain.to_canonical(found), found, rtol=1e-12, atol=1e-12)
        middle = torch.tensor([width - 1, height - 1]).double() / 2
        torch.testing.assert_close(again, height * found[..., :2] / found[..., 2:] + middle)


def test_canonical_points_have_a_gradient_in_points_and_lens() -> None:
    generator = torch.Generator().manual_seed(0)
    points, focal, principal = (
        torch.randn(*shape, generator=generator, dtype=torch.float64).requires_grad_()
        for shape in ((5, 3), (2,), (2,))
    )
    turned = viewpoint_rotation(torch.tensor([0.3, -0.2, 0.1], dtype=torch.float64))

    def seen(points: torch.Tensor, focal: torch.Tensor, principal: torch.Tensor) -> torch.Tensor:
        return Camera(turned, torch.ones(3), focal, principal, 24, 20).to_canonical(points)

    assert torch.autograd.gradcheck(seen, (points, focal, principal))


WHOLE = (torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64)


@pytest.mark.parametrize("kind", WHOLE, ids=str)
@pytest.mark.parametrize("default", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("learned", [False, True])
def test_whole_numbers_are_seen_where_the_same_floats_are(
    kind: torch.dtype, default: torch.dtype, learned: bool
) -> None:
    points = torch.randint(0, 9, (20, 3), generator=torch.Generator().manual_seed(0))
    seen = look_from(0.7, 0.4, -0.2, distance=40.0, field_of_view=0.8, size=(48, 65))
    if learned:
        seen = replace(seen, focal=torch.tensor([50.5, 60.25]), principal=torch.tensor([10.5, 12.75]))
    before = torch.get_default_dtype()
    try:
        torch.set_default_dtype(default)
        for method in (seen.project, seen.to_canonical):
            found, wanted = method(points.to(kind)), method(points.to(default))
            torch.testing.assert_close(found, wanted, rtol=0, atol=0)
    finally:
        torch.set_default_dtype(before)


WRONG = {
    "rotation": (torch.eye(4), torch.eye(3)[None], torch.eye(3)[:2], torch.ones(3)),
    "translation": (torch.ones(1), torch.ones(2), torch.ones(1, 3), torch.tensor(1.0)),
    "focal": ((8.0,), (), (8.0, 8.0, 8.0), 8.0, [8.0], np.ones(3), ((8.0, 8.0), (8.0, 8.0))),
}
WRONG["focal"] += tuple(torch.ones(shape) for shape in ((1,), (3,), (), (1, 2), (2, 1), (0,)))
WRONG["principal"] = WRONG["focal"]
"""Shapes of arrays from which no camera can be built."""


@pytest.mark.parametrize(
    ("name", "value"), [(name, value) for name in WRONG for value in WRONG[name]], ids=repr
)
def test_what_no_camera_is_made_of_gets_a_sentence(name: str, value: object) -> None:
    seen = look_from(0.7, 0.4, -0.2, distance=6.0, field_of_view=0.8, size=(48, 64))
    object.__setattr__(seen, name, value)  # past the type checks that only tests have
    for method in (seen.project, seen.to_canonical):
        with pytest.raises(ValueError, match=rf"camera\.{name} has .*; expected the shape \("):
            method(torch.ones(5, 3))


@pytest.mark.parametrize("number", [2.0, 2])
def test_a_lens_may_be_any_two_numbers(number: float) -> None:
    seen = look_from(0.7, 0.4, -0.2, distance=6.0, field_of_view=0.8, size=(48, 64))
    wanted = replace(seen, focal=(2.0, 2.0), principal=(2.0, 2.0)).project(torch.ones(5, 3))
    for lens in ((number, number), [number, number], np.array([number] * 2), torch.tensor([number] * 2)):
        for name in ("focal", "principal"):
            object.__setattr__(seen, name, lens)
        torch.testing.assert_close(seen.project(torch.ones(5, 3)), wanted, rtol=0, atol=0)


@pytest.mark.parametrize("angle", [40.0, 180.0, math.pi, 3.2, 0.0, -0.8, math.nan, math.inf, -math.inf])
def test_a_field_of_view_in_degrees_is_refused(angle: float) -> None:
    for ask in (
        lambda: look_from(0.3, 0.2, 0.1, distance=4.0, field_of_view=angle, size=(48, 64)),
        lambda: focal_length(48, angle),
    ):
        with pytest.raises(ValueError, match=r"field_of_view = .*; expected radians.*math\.radians"):
            ask()


@pytest.mark.parametrize("angle", [1e-6, 0.1, math.radians(40), 1.5, 3.0, 3.14159])
def test_the_edges_of_an_image_are_seen_at_half_the_field_of_view(angle: float) -> None:
    height = 48
    seen = look_from(0.0, 0.0, 0.0, distance=4.0, field_of_view=angle, size=(height, 64))
    assert seen.focal[0] == seen.focal[1] == focal_length(height, angle)
    assert 2 * math.atan2(height / 2, float(seen.focal[1])) == pytest.approx(angle, rel=1e-9)
