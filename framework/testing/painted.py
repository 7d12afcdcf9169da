"""Checks of a renderer's normals, barycentric and texture coordinates, and of its gradients."""

from dataclasses import replace

import torch
from torch import Tensor

from framework.renderer import Renderer, Scene, Texture
from framework.testing.finding import SEED, Worst
from framework.testing.scenes import SIZE, sphere, square


def normal(renderer: Renderer, worst: Worst) -> None:
    """Check normals of a finely cut sphere against the direction from its centre; the error is 1 - cosine."""
    scene = sphere(rings=120)
    found = renderer(replace(scene, colors=None), ("normal", "depth"))
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    focal, principal = (torch.tensor(part).double() for part in (scene.camera.focal, scene.camera.principal))
    ray = torch.cat([(torch.stack([x, y], -1) - principal) / focal, torch.ones(*SIZE, 1).double()], -1)
    seen = found["depth"].isfinite()
    depth = found["depth"].double().where(seen, 0)
    place = (ray * depth[..., None] - scene.camera.translation.double()) @ scene.camera.rotation.double()
    cosine = (found["normal"].double() * place).sum(-1) / place.norm(dim=-1)
    worst.see((1 - cosine).where(seen, 0), lambda at: f"pixel {at}: {found['normal'][at].tolist()}")


def barycentric(renderer: Renderer, worst: Worst) -> None:
    """Check that the barycentric coordinates give the point of the face seen at the pixel; the error is in pixels."""
    scene = replace(sphere(), colors=None)
    found = renderer(scene, ("barycentric", "face"))
    corners = scene.vertices.double()[scene.faces][found["face"].clamp(min=0).long()]
    pixels, _ = scene.camera.project((found["barycentric"].double()[..., None] * corners).sum(-2))
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    off = (pixels - torch.stack([x, y], -1)).norm(dim=-1)
    worst.see(off.where(found["face"] >= 0, 0), lambda at: f"pixel {at}: {found['barycentric'][at].tolist()}")


def uv(renderer: Renderer, worst: Worst) -> None:
    """Check that texture coordinates are linear in the pixel on a square across the view."""
    scene, places = papered(torch.ones(1, 1, 3))
    found = renderer(replace(scene, colors=None), ("uv",))["uv"].double()
    worst.see((found - places).abs().amax(-1), lambda at: f"pixel {at}: {found[at].tolist()}")
    plain = renderer(replace(scene, colors=None, texture=None), ("uv",))["uv"]
    worst.count(plain != 0, "uv of a scene without a texture")


def texture(renderer: Renderer, worst: Worst) -> None:
    """Check texels without smoothing, wrapped in each way, times the vertex colours.

    A renderer without "uv" must refuse a texture with a ValueError.
    """
    generator = torch.Generator().manual_seed(SEED)
    image = torch.rand(3, 4, 3, generator=generator)
    for wrap in ("repeat", "clamp", "mirror"):
        scene, places = papered(image)
        assert scene.texture is not None and scene.colors is not None
        scene = replace(scene, texture=replace(scene.texture, wrap=wrap, smooth=False))
        if "uv" not in renderer.channels:
            try:
                renderer(scene, ("color",))
            except ValueError:
                worst.count(False, "refused")
                continue
            worst.count(
                True, "a scene with a texture was drawn as if it had none, wanted it drawn or a ValueError"
            )
            continue
        place = torch.stack([places[..., 0] * 4, (1 - places[..., 1]) * 3], -1)
        column, row = (
            wrapped(place[..., axis].floor().long(), side, wrap) for axis, side in ((0, 4), (1, 3))
        )
        alone = renderer(replace(scene, colors=None), ("color",))["color"]
        clear = ((place - place.round()).abs() > 0.02).all(-1)[..., None]
        worst.see(
            (alone - image[row, column]).abs().where(clear, 0),
            lambda at, wrap=wrap: f"{wrap}, pixel {at[:2]}",
        )
        both = renderer(scene, ("color",))["color"]
        plain = renderer(replace(scene, texture=None), ("color",))["color"]
        worst.see(
            (both - alone * plain).abs(), lambda at, wrap=wrap: f"{wrap}, pixel {at[:2]}, times the colours"
        )


def wrapped(place: Tensor, count: int, wrap: str) -> Tensor:
    """Return texel indices within the image for places outside it."""
    if wrap == "clamp":
        return place.clamp(0, count - 1)
    if wrap == "repeat":
        return place % count
    place = place % (2 * count)
    return torch.minimum(place, 2 * count - 1 - place)


def papered(image: Tensor) -> tuple[Scene, Tensor]:
    """Return a square across the view with an image, repeated and rotated, and its uv at each pixel, float64."""
    scene = square(3.0, side=4.0)
    pixels, _ = scene.camera.project(scene.vertices.double())
    slope = torch.tensor([[0.041, 0.013], [-0.017, 0.053]], dtype=torch.float64)
    start = torch.tensor([-1.07, -1.03], dtype=torch.float64)
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    cover = Texture((image,), (pixels @ slope + start).float(), scene.faces)
    return replace(scene, texture=cover), torch.stack([x, y], -1) @ slope + start


def wrapping(scene: Scene) -> Texture:
    """Return a smooth texture that covers a scene once, float64."""
    row, column = torch.meshgrid(torch.arange(16.0), torch.arange(16.0), indexing="ij")
    image = torch.stack([(row / 4 + column / 6 + channel).sin() * 0.3 + 0.6 for channel in range(3)], -1)
    places = 0.5 + 0.4 * scene.vertices[:, :2] + 0.1 * scene.vertices[:, 2:]
    return Texture((image.double(),), places.double(), scene.faces, wrap="clamp")


PART = 4
"""Number of images along each axis, shifted by fractions of a pixel, whose mean approximates integrals over pixels."""
ALONE = 6.0
"""Factor by which the gradient in one parameter may be farther off than that in all together."""


def gradient(renderer: Renderer, worst: Worst) -> None:
    """Check gradients of a weighted sum of pixels against differences, in one direction of each parameter.

    The parameters are those that `differentiable` names. The weights change slowly from pixel to pixel, so that the
    position of the pixel grid matters little.
    """
    scene = sphere()
    if "uv" in renderer.channels:
        scene = replace(scene, texture=wrapping(scene))
    row, column = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    weight = torch.stack(
        [(row / 9 + channel).sin() * (column / 11 - channel).cos() for channel in range(3)], -1
    )
    seen = scene.camera
    assert scene.colors is not None
    given = {
        "vertices": scene.vertices.double(),
        "colors": scene.colors.double(),
        "rotation": seen.rotation.double(),
        "translation": seen.translation.double(),
        "focal": torch.tensor(seen.focal, dtype=torch.float64),
        "principal": torch.tensor(seen.principal, dtype=torch.float64),
    }
    if scene.texture is not None:
        given |= {"texture": scene.texture.images[0], "uv": scene.texture.uv}
    turn = torch.tensor([[0.0, -1, 0.3], [1, 0, -0.2], [-0.3, 0.2, 0]], dtype=torch.float64)
    shape = given["vertices"]
    ways = {
        "vertices": 0.4 * shape[:, [1, 2, 0]].square() + torch.tensor([0.2, 0.1, 0.3], dtype=torch.float64),
        "colors": shape.flip(-1).sin(),
        "rotation": turn @ given["rotation"],
        "translation": torch.tensor([0.3, -0.2, 0.4], dtype=torch.float64),
        "focal": torch.tensor([10.0, 8.0], dtype=torch.float64),
        "principal": torch.tensor([3.0, -4.0], dtype=torch.float64),
    }
    if scene.texture is not None:
        ways |= {"texture": scene.texture.images[0].flip(0), "uv": scene.texture.uv.flip(1) - 0.3}

    def loss(step: torch.Tensor, name: str, parts: int) -> torch.Tensor:
        at = {key: value + step * ways[key] if key == name else value for key, value in given.items()}
        offsets = (torch.arange(parts) + 0.5) / parts - 0.5
        cover = scene.texture
        if cover is not None:
            cover = replace(cover, images=(at["texture"],), uv=at["uv"])
        drawn = [
            renderer(
                Scene(
                    at["vertices"],
                    scene.faces,
                    at["colors"],
                    replace(
                        seen,
                        rotation=at["rotation"],
                        translation=at["translation"],
                        focal=at["focal"],
                        principal=at["principal"] + torch.stack([x, y]),
                    ),
                    cover,
                )
            )["color"]
            for x in offsets
            for y in offsets
        ]
        return (torch.stack(drawn).mean(0) * weight).sum()

    found, wanted = [], []
    for name in sorted(renderer.differentiable):
        step = torch.zeros((), dtype=torch.float64, requires_grad=True)
        found.append(torch.autograd.grad(loss(step, name, PART), step)[0].item())
        with torch.no_grad():
            ends = [loss(torch.tensor(sign * 0.05, dtype=torch.float64), name, 4 * PART) for sign in (1, -1)]
        wanted.append((ends[0] - ends[1]).item() / 0.1)
    one, other = torch.tensor(found), torch.tensor(wanted)
    said = ", ".join(
        f"{name} {a:.4g} for {b:.4g}"
        for name, a, b in zip(sorted(renderer.differentiable), found, wanted, strict=True)
    )
    worst.see(((one - other).norm() / other.norm()).reshape(1), lambda at: said)
    # each parameter alone; edges between pixels make these less exact
    each = (one - other).abs() / other.abs().clamp(min=0.01 * other.norm().item())
    worst.see(each / ALONE, lambda at: said)
