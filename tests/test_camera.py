"""Where a camera sees a point: against OpenCV's documented formula and kornia's camera."""

import math

import numpy as np
import torch
from kornia.geometry.camera import PinholeCamera

from framework.geometry.camera import Camera, look_from


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
