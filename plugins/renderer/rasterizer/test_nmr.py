"""Tests of the gradient of Kato et al., compared pixel by pixel with the paper's definition, and of its effect."""

import math

import numpy as np
import pytest
import torch

from framework.geometry.camera import Camera
from framework.renderer import Scene
from plugins.renderer.rasterizer.renderer import Rasterizer
from plugins.renderer.rasterizer.test_gradient import blob, camera

HEIGHT, WIDTH = 9, 12
DISTANCE_ADDED = 1e-4  # as published, where the image is 2 wide


def unproject(places: np.ndarray, depths: np.ndarray, lens: torch.Tensor) -> torch.Tensor:
    """Return vertices that project to the given positions in pixels."""
    rays = (torch.as_tensor(places) - lens[2:]) / lens[:2]
    z = torch.as_tensor(depths)[:, None]
    return torch.cat([rays * z, z], 1)


def definition_gradient(places, faces, face, color, slopes) -> np.ndarray:
    """Return ∂L/∂(column, row) of every vertex, by the paper's definition.

    For each pixel, face, edge and end i of this edge, it computes how far i must move along the axis, with the other
    end fixed, until the edge meets the pixel, and which colour the pixel would then show.
    """
    gradient = np.zeros_like(places)
    for axis, number, corner in np.ndindex(2, len(faces), 3):
        corners = places[faces[number]]
        (ax, ay), (bx, by), (cx, cy) = corners
        if (bx - ax) * (cy - ay) - (cx - ax) * (by - ay) >= 0:
            continue
        ends = [faces[number][corner], faces[number][(corner + 1) % 3]]
        third = places[faces[number][(corner + 2) % 3]]
        for row, column in np.ndindex(HEIGHT, WIDTH):
            pixel = np.array([column, row])
            line, place = pixel[1 - axis], pixel[axis]
            start, end_point = places[ends[0]], places[ends[1]]
            low, high = sorted([start[1 - axis], end_point[1 - axis]])
            if low == high or not low <= line <= high:
                continue
            crossing = np.interp(
                line,
                [low, high],
                [e[axis] for e in sorted([start, end_point], key=lambda end, axis=axis: end[1 - axis])],
            )
            # on which side of the edge the face is
            normal = np.array([end_point[1] - start[1], start[0] - end_point[0]])
            outwards = -int(np.sign(normal @ (third - start)) * np.sign(normal[axis]))
            inner = math.floor(crossing) if outwards > 0 else math.ceil(crossing)
            outer = inner + outwards
            size = (WIDTH, HEIGHT)[axis]
            if not (0 <= inner < size and 0 <= outer < size):
                continue

            def pixel_index(position, line=line, axis=axis):
                return (line, position) if axis == 0 else (position, line)

            if (place - crossing) * outwards > 0:
                if face[pixel_index(inner)] != number:
                    continue
                change = color[pixel_index(inner)] - color[row, column]
            else:
                if face[row, column] != number:
                    continue
                change = color[pixel_index(outer)] - color[row, column]
            falls = float(slopes[row, column] @ change)
            if falls >= 0:
                continue
            beyond = (place - crossing) * outwards > 0
            for end, fixed in (ends, ends[::-1]):
                moving, pivot = places[end], places[fixed]
                if line == pivot[1 - axis]:
                    continue  # moving this end does not change where the edge crosses this line
                needed = pivot[axis] + (place - pivot[axis]) * (moving[1 - axis] - pivot[1 - axis]) / (
                    line - pivot[1 - axis]
                )
                distance = abs(needed - moving[axis]) + DISTANCE_ADDED * size / 2
                gradient[end, axis] += falls / distance * (outwards if beyond else -outwards)
    return gradient


@pytest.mark.parametrize("whole", [False, True])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(1, 4))])
def test_the_gradient_equals_the_papers_sum_over_pixels_and_edges(seed: int, whole: bool) -> None:
    """Check overlapping faces, including faces seen from behind and faces beyond the image.

    With `whole`, corners lie on pixels and edges lie along lines of pixels.
    """
    random = np.random.default_rng(seed)
    places = random.uniform([-3, -3], [WIDTH + 2, HEIGHT + 2], (9, 2))
    places = np.round(places) if whole else np.round(places * 256) / 256
    if whole:
        places[1, 1], places[4, 0] = places[0, 1], places[3, 0]
    faces = np.concatenate([np.arange(9).reshape(3, 3), random.integers(0, 9, (2, 3))])
    for number in range(2):  # these two faces must face the camera
        ways = places[faces[number, 1:]] - places[faces[number, 0]]
        if np.linalg.det(ways) > 0:
            faces[number] = faces[number, ::-1]
    depths = random.uniform(1, 3, 9)
    lens = torch.tensor([10.0, 11, 5.5, 4], dtype=torch.float64).requires_grad_()
    vertices = unproject(places, depths, lens.detach()).requires_grad_()
    colors = torch.tensor(random.uniform(0, 1, (9, 2))).requires_grad_()
    eye = torch.eye(3, dtype=torch.float64)
    pose = Camera(eye, torch.zeros(3).double(), lens[:2], lens[2:], HEIGHT, WIDTH)
    scene = Scene(vertices, torch.tensor(faces), colors, pose)
    channels = Rasterizer(gradient="nmr")(scene, ("color", "face"))
    slopes = torch.tensor(random.normal(0, 1, (HEIGHT, WIDTH, 2)) * random.integers(0, 2, (HEIGHT, WIDTH, 1)))
    (channels["color"] * slopes).sum().backward()
    picture = channels["color"].detach().double().numpy()
    wanted = definition_gradient(
        places, faces, channels["face"].numpy(), picture, slopes.float().double().numpy()
    )
    assert np.abs(wanted).max() > 0.1

    again, lens_again = vertices.detach().requires_grad_(), lens.detach().clone().requires_grad_()
    projected = again[:, :2] / again[:, 2:] * lens_again[:2] + lens_again[2:]
    (projected * torch.tensor(wanted)).sum().backward()
    torch.testing.assert_close(vertices.grad, again.grad, rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(lens.grad, lens_again.grad, rtol=1e-6, atol=1e-6)


def test_gradients_of_colors_and_depths_equal_those_of_interior() -> None:
    vertices, faces, colors = blob(12)
    slopes, down = torch.rand(72, 88, 3), torch.rand(72, 88)
    gradients = {}
    for gradient in ("interior", "nmr"):
        tinted, moved = colors.clone().requires_grad_(), vertices.clone().requires_grad_()
        channels = Rasterizer(gradient=gradient)(Scene(moved, faces, tinted, camera()), ("color", "depth"))
        (channels["depth"].where(channels["depth"] < math.inf, 0) * down).sum().backward(retain_graph=True)
        of_depth, moved.grad = moved.grad, None
        (channels["color"] * slopes).sum().backward()
        gradients[gradient] = (tinted.grad, of_depth)
    assert all(torch.equal(*pair) for pair in zip(gradients["interior"], gradients["nmr"], strict=True))


def test_the_gradient_points_to_a_target_that_the_face_does_not_touch() -> None:
    """Check that descent leads to the target on the right, at which the gradient of moving edges is nearly 0."""
    eye = torch.eye(3)
    pose = Camera(eye, torch.zeros(3), (20.0, 20.0), (19.5, 9.5), 20, 40)
    corners = torch.tensor([[-0.8, -0.2, 1.0], [-0.5, 0.2, 1], [-0.3, -0.2, 1]])
    faces, colors = torch.tensor([[0, 1, 2]]), torch.ones(3, 1)
    target = Rasterizer()(Scene(corners + torch.tensor([1.0, 0, 0]), faces, colors, pose))["color"]
    way = {}
    for gradient in ("boundary", "nmr"):
        shift = torch.zeros(3, requires_grad=True)
        picture = Rasterizer(gradient=gradient)(Scene(corners + shift, faces, colors, pose))["color"]
        assert 10 < picture.sum() < 200 and (picture * target).sum() == 0
        (picture - target).square().sum().backward()
        way[gradient] = -float(shift.grad[0])
    assert way["nmr"] > 1 > abs(way["boundary"])
