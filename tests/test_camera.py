"""Where a camera sees a point: against OpenCV's documented formula and kornia's camera."""

import math

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera

from framework.geometry.camera import Camera, canonical_camera, look_from
from framework.geometry.rotation import viewpoint_rotation


def test_points_are_seen_where_opencv_and_kornia_say() -> None:
    generator = torch.Generator().manual_seed(0)
    points = torch.randn(50, 3, generator=generator, dtype=torch.float64)
    for azimuth in (-2.0, 0.3, 2.5):
        seen = look_from(azimuth, 0.4, -0.2, distance=6.0, field_of_view=0.8, size=(48, 64))
        pixels, depth = seen.projected(points)
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
    pixels, _ = seen.projected(torch.tensor([[0.5, 0.25, 0.0]]))
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
        pixels, depth = camera.projected(points)
        plain = canonical_camera(height, width)
        found = camera.canonical(points)
        again, same = plain.projected(found)
        assert torch.equal(found[..., 2], depth) and torch.equal(same, depth)  # behind the camera, too
        torch.testing.assert_close(again, pixels, rtol=1e-9, atol=1e-9)
        # the canonical camera's own points stay where they are, and its pixels are those that its docstring says
        torch.testing.assert_close(plain.canonical(found), found, rtol=1e-12, atol=1e-12)
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
        return Camera(turned, torch.ones(3), focal, principal, 24, 20).canonical(points)

    assert torch.autograd.gradcheck(seen, (points, focal, principal))
