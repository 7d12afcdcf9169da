"""Checks of a renderer's normals, barycentric coordinates, textures and gradients.

Each check records its errors in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

from dataclasses import replace

import torch
from torch import Tensor

from framework.renderer import Renderer, Scene, Texture
from framework.testing.finding import SEED, Worst
from framework.testing.scenes import SIZE, sphere, square


def normal(renderer: Renderer, worst: Worst) -> None:
    """Check that normals of a sphere of many faces point away from its centre; the error is 1 - cos(angle)."""
    scene = sphere(rings=120)
    rendered = renderer(replace(scene, colors=None), ("normal", "depth"))
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    focal, principal = (torch.tensor(part).double() for part in (scene.camera.focal, scene.camera.principal))
    ray = torch.cat([(torch.stack([x, y], -1) - principal) / focal, torch.ones(*SIZE, 1).double()], -1)
    visible = rendered["depth"].isfinite()
    depth = rendered["depth"].double().where(visible, 0)
    place = (ray * depth[..., None] - scene.camera.translation.double()) @ scene.camera.rotation.double()
    cosine = (rendered["normal"].double() * place).sum(-1) / place.norm(dim=-1)
    worst.record((1 - cosine).where(visible, 0), lambda at: f"pixel {at}: {rendered['normal'][at].tolist()}")


def barycentric(renderer: Renderer, worst: Worst) -> None:
    """Check that barycentric coordinates give the point that projects to the pixel; the error is in pixels."""
    scene = replace(sphere(), colors=None)
    rendered = renderer(scene, ("barycentric", "face"))
    corners = scene.vertices.double()[scene.faces][rendered["face"].clamp(min=0).long()]
    pixels, _ = scene.camera.project((rendered["barycentric"].double()[..., None] * corners).sum(-2))
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    off = (pixels - torch.stack([x, y], -1)).norm(dim=-1)
    worst.record(
        off.where(rendered["face"] >= 0, 0), lambda at: f"pixel {at}: {rendered['barycentric'][at].tolist()}"
    )


def uv(renderer: Renderer, worst: Worst) -> None:
    """Check that texture coordinates are linear in the pixel for a square that is parallel to the image."""
    scene, coordinates = textured_square(torch.ones(1, 1, 3))
    rendered = renderer(replace(scene, colors=None), ("uv",))["uv"].double()
    worst.record((rendered - coordinates).abs().amax(-1), lambda at: f"pixel {at}: {rendered[at].tolist()}")
    plain = renderer(replace(scene, colors=None, texture=None), ("uv",))["uv"]
    worst.count(plain != 0, "uv is not 0 for a scene without a texture")


def texture(renderer: Renderer, worst: Worst) -> None:
    """Check that textures are drawn without smoothing, for each wrap mode, and multiplied by the vertex colours.

    A renderer without the channel "uv" must refuse a texture with a ValueError.
    """
    generator = torch.Generator().manual_seed(SEED)
    image = torch.rand(3, 4, 3, generator=generator)
    for wrap in ("repeat", "clamp", "mirror"):
        scene, coordinates = textured_square(image)
        assert scene.texture is not None and scene.colors is not None
        scene = replace(scene, texture=replace(scene.texture, wrap=wrap, smooth=False))
        if "uv" not in renderer.channels:
            try:
                renderer(scene, ("color",))
            except ValueError:
                worst.count(False, "the renderer refuses textures")
                continue
            worst.count(True, "the texture of a scene is ignored, expected that it is drawn or a ValueError")
            continue
        texel = torch.stack([coordinates[..., 0] * 4, (1 - coordinates[..., 1]) * 3], -1)
        column, row = (
            wrap_indices(texel[..., axis].floor().long(), side, wrap) for axis, side in ((0, 4), (1, 3))
        )
        texture_only = renderer(replace(scene, colors=None), ("color",))["color"]
        clear = ((texel - texel.round()).abs() > 0.02).all(-1)[..., None]
        worst.record(
            (texture_only - image[row, column]).abs().where(clear, 0),
            lambda at, wrap=wrap: f"{wrap}, pixel {at[:2]}",
        )
        both = renderer(scene, ("color",))["color"]
        colors_only = renderer(replace(scene, texture=None), ("color",))["color"]
        worst.record(
            (both - texture_only * colors_only).abs(),
            lambda at, wrap=wrap: f"{wrap}, pixel {at[:2]}, times the colours",
        )


def wrap_indices(index: Tensor, count: int, wrap: str) -> Tensor:
    """Return texel indices in [0, count) for texel indices that may be outside, by the wrap mode of the texture."""
    if wrap == "clamp":
        return index.clamp(0, count - 1)
    if wrap == "repeat":
        return index % count
    index = index % (2 * count)
    return torch.minimum(index, 2 * count - 1 - index)


def textured_square(image: Tensor) -> tuple[Scene, Tensor]:
    """Return a square that fills the view, with a repeated and rotated texture, and its uv at each pixel, float64."""
    scene = square(3.0, side=4.0)
    pixels, _ = scene.camera.project(scene.vertices.double())
    slope = torch.tensor([[0.041, 0.013], [-0.017, 0.053]], dtype=torch.float64)
    start = torch.tensor([-1.07, -1.03], dtype=torch.float64)
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    cover = Texture((image,), (pixels @ slope + start).float(), scene.faces)
    return replace(scene, texture=cover), torch.stack([x, y], -1) @ slope + start


def smooth_texture(scene: Scene) -> Texture:
    """Return a smooth texture for a scene, without repetition, float64."""
    row, column = torch.meshgrid(torch.arange(16.0), torch.arange(16.0), indexing="ij")
    image = torch.stack([(row / 4 + column / 6 + channel).sin() * 0.3 + 0.6 for channel in range(3)], -1)
    places = 0.5 + 0.4 * scene.vertices[:, :2] + 0.1 * scene.vertices[:, 2:]
    return Texture((image.double(),), places.double(), scene.faces, wrap="clamp")


SUBPIXELS = 4
"""Number of subpixel shifts along each axis over which images are averaged, to approximate integrals over pixels."""
SINGLE = 6.0
"""Factor by which the error of the gradient in one parameter may exceed the error of the gradient in all parameters."""


def gradient(renderer: Renderer, worst: Worst) -> None:
    """Compare derivatives of a weighted sum of pixels with central differences, along one direction in each parameter.

    The parameters are those in the renderer's `differentiable`. The weights vary slowly over the image, so that the
    position of the pixel grid matters little.
    """
    scene = sphere()
    if "uv" in renderer.channels:
        scene = replace(scene, texture=smooth_texture(scene))
    row, column = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    weight = torch.stack(
        [(row / 9 + channel).sin() * (column / 11 - channel).cos() for channel in range(3)], -1
    )
    camera = scene.camera
    assert scene.colors is not None
    parameters = {
        "vertices": scene.vertices.double(),
        "colors": scene.colors.double(),
        "rotation": camera.rotation.double(),
        "translation": camera.translation.double(),
        "focal": torch.tensor(camera.focal, dtype=torch.float64),
        "principal": torch.tensor(camera.principal, dtype=torch.float64),
    }
    if scene.texture is not None:
        parameters |= {"texture": scene.texture.images[0], "uv": scene.texture.uv}
    generator = torch.tensor([[0.0, -1, 0.3], [1, 0, -0.2], [-0.3, 0.2, 0]], dtype=torch.float64)
    shape = parameters["vertices"]
    directions = {
        "vertices": 0.4 * shape[:, [1, 2, 0]].square() + torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64),
        "colors": shape.flip(-1).sin(),
        "rotation": generator @ parameters["rotation"],
        "translation": torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64),
        "focal": torch.tensor([10.0, 8.0], dtype=torch.float64),
        "principal": torch.tensor([3.0, -4.0], dtype=torch.float64),
    }
    if scene.texture is not None:
        directions |= {"texture": scene.texture.images[0].flip(0), "uv": scene.texture.uv.flip(1) - 0.3}

    def loss(step: torch.Tensor, name: str, shifts: int) -> torch.Tensor:
        values = {
            key: value + step * directions[key] if key == name else value for key, value in parameters.items()
        }
        offsets = (torch.arange(shifts) + 0.5) / shifts - 0.5
        cover = scene.texture
        if cover is not None:
            cover = replace(cover, images=(values["texture"],), uv=values["uv"])
        images = [
            renderer(
                Scene(
                    values["vertices"],
                    scene.faces,
                    values["colors"],
                    replace(
                        camera,
                        rotation=values["rotation"],
                        translation=values["translation"],
                        focal=values["focal"],
                        principal=values["principal"] + torch.stack([x, y]),
                    ),
                    cover,
                )
            )["color"]
            for x in offsets
            for y in offsets
        ]
        return (torch.stack(images).mean(0) * weight).sum()

    analytic, numeric = [], []
    for name in sorted(renderer.differentiable):
        step = torch.zeros((), dtype=torch.float64, requires_grad=True)
        analytic.append(torch.autograd.grad(loss(step, name, SUBPIXELS), step)[0].item())
        with torch.no_grad():
            ends = [
                loss(torch.tensor(sign * 0.05, dtype=torch.float64), name, 4 * SUBPIXELS) for sign in (1, -1)
            ]
        numeric.append((ends[0] - ends[1]).item() / 0.1)
    analytic_values, numeric_values = torch.tensor(analytic), torch.tensor(numeric)
    comparison = "; ".join(
        f"{name} {a:.4g}, by differences {b:.4g}"
        for name, a, b in zip(sorted(renderer.differentiable), analytic, numeric, strict=True)
    )
    worst.record(
        ((analytic_values - numeric_values).norm() / numeric_values.norm()).reshape(1), lambda at: comparison
    )
    # derivatives in single parameters are less accurate, since edges move across pixel centres
    relative_errors = (analytic_values - numeric_values).abs() / numeric_values.abs().clamp(
        min=0.01 * numeric_values.norm().item()
    )
    worst.record(relative_errors / SINGLE, lambda at: comparison)
