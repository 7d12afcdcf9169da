"""Tests of gradients of images, compared with autograd of plain formulas and with differences of sharp images."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from framework.geometry.camera import Camera, look_from
from framework.renderer import Scene, Texture
from plugins.renderer.rasterizer.drawing import Gradient
from plugins.renderer.rasterizer.renderer import Rasterizer

torch_float = torch.float64


def blob(rings: int = 40) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return a closed body that occludes parts of itself (a sphere with two bumps and a dent), with smooth colours."""
    theta = torch.linspace(0, math.pi, rings + 1, dtype=torch_float)
    phi = torch.arange(2 * rings, dtype=torch_float) * (math.pi / rings)
    x, y = torch.outer(theta.sin(), phi.cos()), torch.outer(theta.sin(), phi.sin())
    z = theta.cos()[:, None].expand_as(x)
    unit = torch.stack([x, y, z], -1)
    radius = 0.6 + 0.35 * (3 * x).cos() * (2 * z).sin() + 0.2 * (4 * phi).cos() * theta.sin()[:, None]
    row, column = torch.meshgrid(torch.arange(rings), torch.arange(2 * rings), indexing="ij")
    a, b = row * 2 * rings + column, row * 2 * rings + (column + 1) % (2 * rings)
    faces = torch.cat(
        [torch.stack([a, a + 2 * rings, b], -1), torch.stack([b, a + 2 * rings, b + 2 * rings], -1)]
    )
    vertices = (radius[..., None] * unit).reshape(-1, 3)
    colors = 0.5 + 0.5 * torch.sin(
        2.0 * vertices @ torch.tensor([[1.0, 2, 0], [0, 1, 2], [2, 0, 1]]).double()
    )
    return vertices, faces.reshape(-1, 3), colors


def camera(azimuth: float = 0.5, size: tuple[int, int] = (72, 88)) -> Camera:
    pose = look_from(azimuth, 0.3, 0.1, 3.2, 0.6, size)
    lens = [torch.tensor(part, dtype=torch_float) for part in (pose.focal, pose.principal)]
    return replace(
        pose,
        rotation=pose.rotation.double(),
        translation=pose.translation.double(),
        focal=lens[0],
        principal=lens[1],
    )


def rotate_by(rotation: torch.Tensor, by: torch.Tensor) -> torch.Tensor:
    """Return exp([by]×) R."""
    zero = torch.zeros_like(by[0])
    cross = torch.stack(
        [
            torch.stack([zero, -by[2], by[1]]),
            torch.stack([by[2], zero, -by[0]]),
            torch.stack([-by[1], by[0], zero]),
        ]
    )
    return torch.linalg.matrix_exp(cross) @ rotation


DEFORMATIONS = {
    "along x": lambda v: torch.tensor([1.0, 0, 0]).expand_as(v),
    "along y": lambda v: torch.tensor([0, 1.0, 0]).expand_as(v),
    "up": lambda v: torch.tensor([0, 0, 1.0]).expand_as(v),
    "wider": lambda v: v * torch.tensor([1.0, 1, 0]),
    "taller": lambda v: v * torch.tensor([0, 0, 1.0]),
    "twisted": lambda v: torch.stack([-v[:, 1] * v[:, 2], v[:, 0] * v[:, 2], 0 * v[:, 0]], -1),
    "sheared": lambda v: torch.stack([v[:, 2], 0 * v[:, 0], 0 * v[:, 0]], -1),
    "bent": lambda v: torch.stack([torch.sin(3 * v[:, 2]), torch.cos(2 * v[:, 2]), 0 * v[:, 2]], -1),
}
VIEWS = (0.5, 2.0, 3.6, 5.2)


KINDS = {
    "vertices": ("vertices", False),
    "colors": ("colors", False),
    "rotation": ("rotation", False),
    "translation": ("translation", False),
    "focal": ("focal", False),
    "texture": ("texture", True),
    "vertices, textured": ("vertices", True),
}
"""Parameter of each test, and whether the body has a texture instead of colours."""


def parameters() -> dict[str, torch.Tensor]:
    """Return parameters of the scene; the unchanged scene has the value 0 for all of them."""
    sizes = {"vertices": 8, "colors": 3, "rotation": 3, "translation": 3, "focal": 1, "texture": 3}
    return {name: torch.zeros(size, dtype=torch_float, requires_grad=True) for name, size in sizes.items()}


def scene(
    by: dict[str, torch.Tensor], azimuth: float, body: tuple[torch.Tensor, ...], textured: bool = False
) -> Scene:
    vertices, faces, colors = body
    moved = vertices + 0.3 * sum(
        amount * move(vertices).double()
        for amount, move in zip(by["vertices"], DEFORMATIONS.values(), strict=True)
    )
    pose = camera(azimuth)
    pose = replace(
        pose,
        rotation=rotate_by(pose.rotation, by["rotation"]),
        translation=pose.translation + by["translation"],
        focal=pose.focal * (1 + by["focal"]),
    )
    if not textured:
        return Scene(moved, faces, colors + torch.sin(3 * vertices) * by["colors"], pose)
    row, column = torch.meshgrid(torch.arange(48.0), torch.arange(64.0), indexing="ij")
    stripes = [(row / 5 + column / (7 + channel) + channel).sin() for channel in range(3)]
    image = 0.5 + 0.4 * torch.stack(stripes, -1).double()
    image = image + torch.sin(3 * image) * by["texture"]
    uv = 0.5 + 0.35 * vertices[:, :2] + 0.2 * vertices[:, 2:]
    return Scene(moved, faces, None, pose, Texture((image,), uv, faces))


@pytest.mark.slow
def test_gradients_equal_differences_of_supersampled_images() -> None:
    """Compare gradients with differences of supersampled images, by cosine and length over all parameters of a kind.

    The loss is the squared error against another pose, over four views. The parameters are 8 deformations, colours, the
    camera's rotation, translation and focal length, and a texture. With one sample per pixel, the loss
    differs, so only the cosine is compared.
    """
    body = blob()
    hard = Rasterizer(supersampling=16)
    tried = {
        "16 samples": Rasterizer(supersampling=4),
        "1 sample": Rasterizer(),
        "interior": Rasterizer(supersampling=4, gradient="interior"),
    }
    gradients: dict[tuple[str, str], list[float]] = {}
    differences: dict[str, list[float]] = {}
    for view, azimuth in enumerate(VIEWS):
        torch.manual_seed(view)
        off = {name: 0.05 * torch.randn_like(value.detach()) for name, value in parameters().items()}
        with torch.no_grad():
            targets = [hard(scene(off, azimuth, body, textured))["color"] for textured in (False, True)]

        def loss(renderer, by, textured, azimuth=azimuth, targets=targets):
            picture = renderer(scene(by, azimuth, body, textured))["color"]
            return (picture.double() - targets[textured]).square().sum()

        for how, renderer in tried.items():
            for textured in (False, True):
                by = parameters()
                loss(renderer, by, textured).backward()
                for kind, (name, is_textured) in KINDS.items():
                    if is_textured == textured:
                        gradients.setdefault((how, kind), []).extend(by[name].grad.tolist())
        step = 2e-3
        for kind, (name, textured) in KINDS.items():
            for index in range(len(parameters()[name])):
                ends = []
                for sign in (1, -1):
                    moved = {key: part.detach().clone() for key, part in parameters().items()}
                    moved[name][index] += sign * step
                    with torch.no_grad():
                        ends.append(loss(hard, moved, textured).item())
                differences.setdefault(kind, []).append((ends[0] - ends[1]) / (2 * step))

    def cosine(how: str, kind: str) -> float:
        gradient, expected = np.array(gradients[how, kind]), np.array(differences[kind])
        return gradient @ expected / np.linalg.norm(gradient) / np.linalg.norm(expected)

    for kind, expected in differences.items():
        assert cosine("16 samples", kind) > 0.99, kind
        assert abs(np.linalg.norm(gradients["16 samples", kind]) / np.linalg.norm(expected) - 1) < 0.05, kind
        assert cosine("1 sample", kind) > 0.99, kind
    assert cosine("interior", "vertices") < 0.9  # without the gradient of moving edges, the result is wrong


@pytest.mark.parametrize("behind", [False, True])
def test_gradients_inside_a_face_equal_those_of_the_plane(behind: bool) -> None:
    """Compare gradients of colour and depth with respect to every parameter with autograd through rays and planes.

    Only pixels inside of the face are compared, also for a face that the near plane cuts.
    """
    torch.manual_seed(0)
    vertices = torch.tensor(
        [[-2.0, -2, 4], [3, -1, 5], [-1, 0.3, -1.0] if behind else [-1, 3, 3]], dtype=torch_float
    )
    colors = torch.rand(3, 4, dtype=torch_float)
    rotation = rotate_by(torch.eye(3, dtype=torch_float), torch.tensor([0.1, -0.05, 0.2]).double())
    translation = torch.tensor([0.02, 0.03, 0.1], dtype=torch_float)
    focal, principal = torch.tensor([40.0, 45.0]).double(), torch.tensor([12.2, 9.7]).double()
    inputs = [
        part.clone().requires_grad_() for part in (vertices, colors, rotation, translation, focal, principal)
    ]
    pose = Camera(inputs[2], inputs[3], inputs[4], inputs[5], 20, 24, 0.5)
    faces = torch.tensor([[0, 2, 1]])
    channels = Rasterizer()(Scene(inputs[0], faces, inputs[1], pose), ("color", "depth", "mask"))
    covered = channels["mask"]
    assert 20 < covered.sum() < 480
    slope, down = torch.rand(20, 24, 4), torch.rand(20, 24)
    inside = covered & (torch.nn.functional.avg_pool2d(covered.float()[None], 3, 1, 1)[0] == 1)
    slope, down = slope * inside[..., None], down * inside
    ((slope * channels["color"]).sum() + (down * channels["depth"].where(inside, 0)).sum()).backward()

    copies = [part.detach().clone().requires_grad_() for part in inputs]
    x = copies[0] @ copies[2].T + copies[3]
    row, column = torch.meshgrid(torch.arange(20.0).double(), torch.arange(24.0).double(), indexing="ij")
    place = torch.stack([column, row], -1)
    ray = torch.cat([(place - copies[5]) / copies[4], torch.ones(20, 24, 1).double()], -1)
    a, b, c = x
    parts = torch.stack([ray @ torch.linalg.cross(*pair) for pair in ((b, c), (c, a), (a, b))], -1)
    color = parts / parts.sum(-1, keepdim=True) @ copies[1]
    depth = (a @ torch.linalg.cross(b, c)) / parts.sum(-1)
    ((slope * color)[inside].sum() + (down * depth)[inside].sum()).backward()
    for actual, expected in zip(inputs, copies, strict=True):
        torch.testing.assert_close(
            actual.grad, expected.grad, rtol=2e-3, atol=2e-3 * float(expected.grad.abs().max())
        )


def test_gradients_inside_a_face_equal_differences() -> None:
    """Compare gradients of colour and depth with central differences of the image itself.

    All numbers of a scene are varied whose single face covers all pixels.
    """
    torch.manual_seed(0)
    slope, down = torch.rand(20, 24, 4), torch.rand(20, 24)
    inputs = {
        "vertices": torch.tensor([[-8.0, -8, 4], [9, -6, 5], [-1, 9, 3]], dtype=torch_float),
        "colors": torch.rand(3, 4, dtype=torch_float),
        "translation": torch.tensor([0.02, 0.03, 0.1], dtype=torch_float),
        "focal": torch.tensor([40.0, 45.0]).double(),
        "principal": torch.tensor([12.2, 9.7]).double(),
    }
    rotation = rotate_by(torch.eye(3, dtype=torch_float), torch.tensor([0.1, -0.05, 0.2]).double())

    def loss(vertices: torch.Tensor, colors: torch.Tensor, *pose: torch.Tensor) -> torch.Tensor:
        translation, focal, principal = pose
        viewpoint = Camera(rotation, translation, focal, principal, 20, 24, 0.5)
        channels = Rasterizer()(
            Scene(vertices, torch.tensor([[0, 2, 1]]), colors, viewpoint), ("color", "depth")
        )
        assert bool(channels["depth"].isfinite().all())
        return (slope * channels["color"]).double().sum() + (down * channels["depth"]).double().sum()

    learned = [part.clone().requires_grad_() for part in inputs.values()]
    gradients = torch.autograd.grad(loss(*learned), learned)
    for number, (name, part) in enumerate(inputs.items()):
        differences = torch.zeros_like(part)
        # pixels or metres; large, because images are rounded to float32
        step = 0.3 if name in ("focal", "principal") else 1e-3
        for index in range(part.numel()):
            ends = []
            for sign in (1, -1):
                parts = [other.clone() for other in inputs.values()]
                parts[number].view(-1)[index] += sign * step
                with torch.no_grad():
                    ends.append(loss(*parts).item())
            differences.view(-1)[index] = (ends[0] - ends[1]) / (2 * step)
        largest = float(differences.abs().max())
        torch.testing.assert_close(
            gradients[number],
            differences,
            rtol=0,
            atol=1e-3 * largest,
            msg=lambda message, name=name: f"{name}: {message}",
        )


@pytest.mark.parametrize("gradient", ["boundary", "interior", "nmr", "soft"])
def test_gradients_of_extreme_scenes_are_finite(gradient: Gradient) -> None:
    edge_on = torch.tensor([[0.0, 0, 2], [0, 0, 3], [0, 0.5, 2.5]])
    sliver = torch.tensor([[-1.0, 0, 2], [1, 1e-7, 2], [0, 2e-7, 2]])
    everywhere = torch.tensor([[-1e6, -1e6, 1.0], [1e6, -1e6, 1.0], [0, 1e6, 1.0]])
    crossing = torch.tensor([[-1.0, -1, -2], [1, -1, 3], [0, 1, 2.0]])
    plane = torch.tensor([[-1.0, -1, 1e-3], [1, -1, 1e-3], [0, 1, 2.0]])
    bad = torch.tensor([[math.nan, 0, 1], [0, math.inf, 1], [0, 0, 1.0]])
    for corners in (edge_on, sliver, everywhere, crossing, plane, bad):
        for focal in (1e-3, 30.0, 1e6):
            vertices = torch.cat([corners, torch.tensor([[-0.3, -0.3, 4.0], [0.3, -0.3, 4], [0, 0.3, 4]])])
            differentiable = vertices.clone().requires_grad_()
            lens = torch.tensor([focal, focal]).double().requires_grad_()
            pose = Camera(torch.eye(3), torch.zeros(3), lens, (8.0, 8.0), 17, 17)
            faces = torch.tensor([[0, 1, 2], [0, 2, 1], [3, 4, 5]])
            colors = torch.rand(6, 3).requires_grad_()
            channels = Rasterizer(gradient=gradient)(
                Scene(differentiable, faces, colors, pose), ("color", "depth")
            )
            # terms of both signs, because nmr ignores changes that do not lower the loss
            (channels["color"].square().sum() - channels["color"].sum()).backward(retain_graph=True)
            channels["depth"].where(channels["depth"] < math.inf, 0).sum().backward()
            assert channels["color"].isfinite().all()
            assert all(part.grad.isfinite().all() for part in (differentiable, colors, lens))


@pytest.mark.parametrize("gradient", ["boundary", "nmr", "soft"])
def test_the_gradient_of_depth_does_not_depend_on_other_channels(gradient: Gradient) -> None:
    vertices, faces, colors = blob(12)
    gradients = []
    for channels in (("depth",), ("depth", "mask"), ("color", "depth"), ("face", "depth")):
        for supersampling in (1, 2):
            differentiable = vertices.clone().requires_grad_()
            renderer = Rasterizer(gradient=gradient, supersampling=supersampling)
            depth = renderer(Scene(differentiable, faces, colors, camera()), channels)["depth"]
            depth.where(depth < math.inf, 0).sum().backward()
            gradients.append(differentiable.grad)
    assert gradients[0].abs().max() > 0
    for other in gradients[1:]:
        torch.testing.assert_close(other, gradients[0], rtol=1e-9, atol=1e-9)


def test_only_requested_gradients_are_tracked() -> None:
    vertices, faces, colors = blob(8)
    channels = Rasterizer()(Scene(vertices, faces, colors, camera()), ("color", "depth", "face", "mask"))
    assert not any(value.requires_grad for value in channels.values())
    learned = Scene(vertices, faces, colors.clone().requires_grad_(), camera())
    channels = Rasterizer()(learned, ("color", "face", "mask"))
    assert (
        channels["color"].requires_grad
        and not channels["face"].requires_grad
        and not channels["mask"].requires_grad
    )
