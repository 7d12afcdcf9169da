"""Contract tests of a renderer: one function for each property; each reports its worst case."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from framework.geometry.camera import look_from
from framework.renderer import Renderer, Scene
from framework.testing.compared import (
    color_gradient,
    colors,
    depth,
    draws_points,
    points,
    several,
    visibility,
)
from framework.testing.extremes import extremes
from framework.testing.finding import Finding, Worst, examined
from framework.testing.painted import barycentric, gradient, normal, texture, uv
from framework.testing.rows import RendererRow
from framework.testing.scenes import SIZE, camera, empty, sphere, square

Make = Callable[[], Renderer]
OF_TRIANGLES = {"no holes", "sphere: depth, metres", "what the near plane cuts", "extreme scenes"}
"""Properties that are left out for a renderer that draws sets of points, where its row says so."""


def examine_renderer(row: RendererRow, build: Make) -> Iterator[Finding]:
    """Yield one finding for each property of a renderer."""
    checks: dict[str, tuple[float, Callable[[Renderer, Worst], None]]] = {
        "only the channels asked for": (0.0, _channels),
        "what it cannot draw is refused": (0.0, _refusals),
        "same scene, same bits": (0.0, _repeatable),
        "nothing seen is background": (0.0, _background),
        "no faces, nothing seen": (0.0, _no_faces),
        "bad triangles are left out": (0.0, _bad_triangles),
        "lower face wins": (0.0, _ties),
        "no holes": (0.0, _no_holes),
        "nearer hides farther": (0.0, _hiding),
        "sphere: depth, metres": (2e-3, _sphere),
        "one pixel, one row": (0.0, _small),
        "where the camera says": (0.0, _places),
        "what the near plane cuts": (2e-3, _cut),
        "extreme scenes": (0.0, extremes),
        "colours": (2e-3, colors),
        "visible faces": (0.0, visibility),
        "depth, relative": (1e-3, depth),
        "several scenes": (0.0, several),
        "points": (0.0, points),
    }
    renderer = build()
    for channel, check in (("normal", normal), ("barycentric", barycentric), ("uv", uv)):
        if channel in renderer.channels:
            checks[channel] = (0.02, check)
    if "color" in renderer.channels:
        checks["textures are drawn or refused"] = (1e-6, texture)
    if renderer.differentiable:
        checks["gradient"] = (0.05, gradient)
        checks["gradient in colours"] = (5e-3, color_gradient)
    left_out = {*row.leave_out}
    if "no faces, nothing seen" in row.leave_out and draws_points(renderer):
        left_out |= OF_TRIANGLES
    for name, (limit, check) in checks.items():
        if name not in left_out:
            yield examined(
                name,
                row.limits.get(name, limit),
                lambda worst, check=check: check(build(), worst),
                seconds=60.0,
            )


def _channels(renderer: Renderer, worst: Worst) -> None:
    scene, every = sphere(), sorted(renderer.channels)
    together = renderer(scene, every)
    worst.same("channels drawn", sorted(together), every)
    worst.same("channels of none asked", dict(renderer(scene, ())), {})
    wanted = {
        "color": (torch.float32, (*SIZE, 3)),
        "depth": (torch.float32, SIZE),
        "face": (torch.int32, SIZE),
        "mask": (torch.bool, SIZE),
        "normal": (torch.float32, (*SIZE, 3)),
        "barycentric": (torch.float32, (*SIZE, 3)),
        "uv": (torch.float32, (*SIZE, 2)),
    }
    for name in every:
        alone = renderer(replace(scene, colors=scene.colors if name == "color" else None), (name,))
        worst.same(f"channels when {name} is asked for", sorted(alone), [name])
        worst.same_bits(f"{name} alone and with the others", alone[name], together[name])
        if name in wanted:
            worst.same(f"{name}", (alone[name].dtype, tuple(alone[name].shape)), wanted[name])


def _refusals(renderer: Renderer, worst: Worst) -> None:
    scene, some = sphere(), sorted(renderer.channels)[:1]
    wrong: dict[str, tuple[Scene, tuple[str, ...]]] = {
        "a channel that does not exist": (scene, ("colour of the wind",)),
        "faces beyond the vertices": (replace(scene, faces=scene.faces + len(scene.vertices)), tuple(some)),
        "negative faces": (replace(scene, faces=-scene.faces - 1), tuple(some)),
    }
    if "color" in renderer.channels:
        wrong["colour of a scene without"] = (replace(scene, colors=None), ("color",))
    for what, (bad, channels) in wrong.items():
        try:
            renderer(bad, channels)
        except ValueError as error:
            worst.count(len(str(error)) < 10, f"{what}: {error}")
        else:
            worst.count(True, f"{what}: drawn, wanted a ValueError")


def _repeatable(renderer: Renderer, worst: Worst) -> None:
    """Check that a scene gives the same bits, also after another scene was drawn: the renderer keeps no state."""
    first = renderer(sphere(), sorted(renderer.channels))
    renderer(square(2.0), sorted(renderer.channels))
    for name, again in renderer(sphere(), sorted(renderer.channels)).items():
        worst.same_bits(name, again, first[name])


def _no_faces(renderer: Renderer, worst: Worst) -> None:
    """Check that a scene without faces shows the background; rows of renderers of point sets leave this out."""
    _is_background(renderer, empty(sphere()), "no faces", worst)


def _background(renderer: Renderer, worst: Worst) -> None:
    scene = sphere()
    away = torch.tensor([1e3, 1e3, 1e3])
    scenes = {
        "no vertices": replace(empty(scene), vertices=torch.zeros(0, 3), colors=torch.zeros(0, 3)),
        "behind the camera": square(-3.0),
        "out of view": replace(scene, vertices=scene.vertices + away),
        "nearer than the near plane": square(camera().near / 2, side=1e-4),
    }
    for what, unseen in scenes.items():
        _is_background(renderer, unseen, what, worst)


def _bad_triangles(renderer: Renderer, worst: Worst) -> None:
    scene = square(3.0)
    point = scene.vertices[:1].expand(4, 3)
    for what, vertices in {
        "NaN": torch.full_like(scene.vertices, math.nan),
        "infinite": torch.full_like(scene.vertices, math.inf),
        "one point": point,
        "a line": scene.vertices[:1]
        + torch.arange(4.0)[:, None] * (scene.vertices[1:2] - scene.vertices[:1]) / 3,
    }.items():
        _is_background(renderer, replace(scene, vertices=vertices), what, worst)
    # a bad triangle beside good ones leaves the good ones unchanged
    mixed = replace(
        scene,
        vertices=torch.cat([scene.vertices, torch.tensor([[math.nan, 0, 0]])]),
        colors=None,
        faces=torch.cat([scene.faces, torch.tensor([[0, 1, 4]])]),
    )
    channels = sorted(renderer.channels - {"color"})
    good = renderer(replace(scene, colors=None), channels)
    for name, found in renderer(mixed, channels).items():
        worst.same_bits(f"{name} beside a bad triangle", found, good[name])


def _is_background(renderer: Renderer, scene: Scene, what: str, worst: Worst) -> None:
    drawn = renderer(scene, sorted(renderer.channels))
    background: dict[str, float] = {"depth": math.inf, "face": -1, "mask": 0}
    background |= {"normal": 0.0, "barycentric": 0.0, "uv": 0.0}
    for name, value in drawn.items():
        if name == "color":
            off = (value - renderer.background).abs()
            worst.see(off, f"color of a scene {what}: {value.flatten()[int(off.argmax())].item():.6g}")
        elif name in background:
            worst.count(value != background[name], f"{name} of a scene {what}")


def _ties(renderer: Renderer, worst: Worst) -> None:
    """Check that of equal surfaces the one with the lowest face index is seen."""
    if "face" not in renderer.channels:
        worst.count(False, "draws no faces")
        return
    scene = square(3.0)
    doubled = replace(scene, faces=scene.faces.repeat(3, 1))
    face = renderer(doubled, ("face",))["face"]
    worst.count(~((face == 0) | (face == 1)), "faces seen of three equal squares")


def _no_holes(renderer: Renderer, worst: Worst) -> None:
    """Check that a square of thousands of triangles across the view covers every pixel."""
    scene = square(3.0)
    side = 57
    part = torch.linspace(0, 1, side, dtype=torch.float64)
    u, v = torch.meshgrid(part, part, indexing="ij")
    corner = scene.vertices.double()
    vertices = corner[0] + u[..., None] * (corner[1] - corner[0]) + v[..., None] * (corner[3] - corner[0])
    row, column = torch.meshgrid(torch.arange(side - 1), torch.arange(side - 1), indexing="ij")
    a = (row * side + column).reshape(-1)
    faces = torch.cat(
        [torch.stack([a, a + side + 1, a + side], -1), torch.stack([a, a + 1, a + side + 1], -1)]
    )
    faces = torch.cat([faces, faces.flip(-1)])  # visible from both sides
    mesh = Scene(vertices.reshape(-1, 3).float(), faces, None, scene.camera)
    if "mask" in renderer.channels:
        worst.count(~renderer(mesh, ("mask",))["mask"], "pixels of a closed surface not covered")
    elif "depth" in renderer.channels:
        worst.count(~renderer(mesh, ("depth",))["depth"].isfinite(), "pixels of a closed surface not covered")
    else:
        worst.count(False, "draws neither mask nor depth")


def _hiding(renderer: Renderer, worst: Worst) -> None:
    if "face" not in renderer.channels:
        worst.count(False, "draws no faces")
        return
    far, near = square(5.0), square(2.0)
    for order, (first, second) in {"far first": (far, near), "near first": (near, far)}.items():
        both = Scene(
            torch.cat([first.vertices, second.vertices]),
            torch.cat([first.faces, second.faces + 4]),
            None,
            far.camera,
        )
        face = renderer(both, ("face",))["face"]
        of_near = face >= 2 if first is far else (face >= 0) & (face < 2)
        worst.count(~of_near, f"pixels that do not show the nearer square, {order}")


def _sphere(renderer: Renderer, worst: Worst) -> None:
    """Check the depth of a finely cut sphere against the intersection of each ray, away from the outline; metres."""
    if "depth" not in renderer.channels:
        worst.count(False, "draws no depth")
        return
    scene = sphere(rings=120)
    depth = renderer(replace(scene, colors=None), ("depth",))["depth"].double()
    seen = scene.camera
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    ray = torch.stack(
        [
            (x - seen.principal[0]) / seen.focal[0],
            (y - seen.principal[1]) / seen.focal[1],
            torch.ones_like(x),
        ],
        -1,
    )
    centre = seen.translation.double()  # centre of the sphere in the camera's frame
    along, square_of_ray = ray @ centre, ray.square().sum(-1)
    inside = along.square() - square_of_ray * (centre.square().sum() - 1)
    true = (along - inside.clamp(min=0).sqrt()) / square_of_ray
    clear = inside > 0.3 * inside.max()
    worst.see((depth - true).abs().where(clear, 0), lambda at: f"pixel {at}: {depth[at].item():.6g} m")


def _small(renderer: Renderer, worst: Worst) -> None:
    scene = sphere()
    for height, width in ((1, 1), (1, 64), (64, 1)):
        view = look_from(0.0, 0.0, 0.0, distance=4.0, field_of_view=0.1, size=(height, width))
        for name, value in renderer(replace(scene, camera=view), sorted(renderer.channels)).items():
            shape = (
                height,
                width,
                *{"color": (3,), "normal": (3,), "barycentric": (3,), "uv": (2,)}.get(name, ()),
            )
            worst.same(f"{name} of {height} × {width}", tuple(value.shape), shape)
            if isinstance(value, Tensor) and value.is_floating_point() and name == "color":
                worst.finite(f"{name} of {height} × {width}", value)


def _places(renderer: Renderer, worst: Worst) -> None:
    """Check that a triangle inside one pixel is drawn at the pixel and depth that `Camera.project` returns."""
    if "mask" not in renderer.channels:
        worst.count(False, "draws no mask")
        return
    seen = camera()
    focal, principal = (torch.tensor(part, dtype=torch.float64) for part in (seen.focal, seen.principal))
    around = torch.tensor([[-0.4, -0.3], [0.4, -0.3], [0.0, 0.45]], dtype=torch.float64)
    for row in range(3, SIZE[0], 7):
        for column in range(2, SIZE[1], 9):
            depth = 1.0 + (3 * row + column) % 5
            pixels = torch.tensor([column, row], dtype=torch.float64) + around
            inside = (
                torch.cat([(pixels - principal) / focal, torch.ones(3, 1, dtype=torch.float64)], -1) * depth
            )
            world = (inside - seen.translation.double()) @ seen.rotation.double()
            place, far = seen.project(world)
            worst.count(
                bool((place - pixels).abs().max() > 1e-4), f"pixel {row, column}: projected to {place}"
            )
            worst.count(bool((far - depth).abs().max() > 1e-4), f"pixel {row, column}: depth {far}")
            faces = torch.tensor([[0, 1, 2], [0, 2, 1]])  # visible from both sides
            mask = renderer(Scene(world.float(), faces, None, seen), ("mask",))["mask"]
            found = mask.nonzero().tolist()
            worst.count(found != [[row, column]], f"pixel {row, column}: drawn at {found}")


def _cut(renderer: Renderer, worst: Worst) -> None:
    """Check the relative depth of a floor that extends behind the camera; it may also be left out."""
    if "depth" not in renderer.channels:
        worst.count(False, "draws no depth")
        return
    seen = replace(camera(), rotation=torch.eye(3), translation=torch.zeros(3), near=0.5)
    vertices = torch.tensor([[-90.0, 1, -50], [90, 1, -50], [90, 1, 50], [-90, 1, 50]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    depth = renderer(Scene(vertices, faces, None, seen), ("depth",))["depth"].double()
    if not depth.isfinite().any():
        return
    down = (torch.arange(SIZE[0], dtype=torch.float64) - seen.principal[1]) / seen.focal[1]
    true = (1 / down).where(down > 0, math.inf)[:, None].expand(SIZE)
    clear = (true > 0.6) & (true < 40)
    off = (depth / true - 1).abs().nan_to_num(math.inf)
    worst.see(
        off.where(clear, 0), lambda at: f"pixel {at}: {depth[at].item():.6g} m, wanted {true[at].item():.6g}"
    )
    worst.count(depth.isfinite() & (true > 60), "pixels above the floor's end are drawn")
