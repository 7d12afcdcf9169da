"""Contract tests of a renderer: one function for each property; each records its largest error."""

import math
from collections.abc import Callable, Iterator
from dataclasses import replace

import torch
from torch import Tensor

from framework.geometry.camera import look_from
from framework.renderer import Renderer, Scene
from framework.testing.extremes import extremes
from framework.testing.finding import Finding, Worst, run_check
from framework.testing.image_checks import (
    color_gradient,
    colors,
    depth,
    draws_points,
    points,
    scene_batches,
    visibility,
)
from framework.testing.rows import RendererRow
from framework.testing.scenes import SIZE, camera, empty, sphere, square
from framework.testing.surface_checks import barycentric, gradient, normal, texture, uv

Make = Callable[[], Renderer]
OF_TRIANGLES = {"no holes", "sphere: depth, metres", "faces cut by the near plane", "extreme scenes"}
"""Properties that are not checked for a renderer of point sets whose row leaves out "no faces, only background"."""


def examine_renderer(row: RendererRow, build: Make) -> Iterator[Finding]:
    """Yield one finding for each property of a renderer.

    Args:
        row: Contract row of the renderer.
        build: Function that returns a new renderer with the row's parameters.
    """
    checks: dict[str, tuple[float, Callable[[Renderer, Worst], None]]] = {
        "only the requested channels": (0.0, _channels),
        "scenes that cannot be drawn are refused": (0.0, _refusals),
        "same scene, same bits": (0.0, _repeatable),
        "empty view is background": (0.0, _background),
        "no faces, only background": (0.0, _no_faces),
        "bad triangles are left out": (0.0, _bad_triangles),
        "lower face wins": (0.0, _equal_faces),
        "no holes": (0.0, _no_holes),
        "nearer hides farther": (0.0, _nearer_surface),
        "sphere: depth, metres": (2e-3, _sphere),
        "one pixel, one row": (0.0, _small_images),
        "drawn at the projected pixel": (0.0, _projected_pixels),
        "faces cut by the near plane": (2e-3, _near_plane),
        "extreme scenes": (0.0, extremes),
        "colours": (2e-3, colors),
        "visible faces": (0.0, visibility),
        "depth, relative": (1e-3, depth),
        "several scenes": (0.0, scene_batches),
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
    if "no faces, only background" in row.leave_out and draws_points(renderer):
        left_out |= OF_TRIANGLES
    for name, (limit, check) in checks.items():
        if name not in left_out:
            yield run_check(
                name,
                row.limits.get(name, limit),
                lambda worst, check=check: check(build(), worst),
                seconds=60.0,
            )


def _channels(renderer: Renderer, worst: Worst) -> None:
    scene, every = sphere(), sorted(renderer.channels)
    together = renderer(scene, every)
    worst.same("channels drawn", sorted(together), every)
    worst.same("channels drawn when none is requested", dict(renderer(scene, ())), {})
    expected = {
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
        worst.same(f"channels drawn when only {name} is requested", sorted(alone), [name])
        worst.same_bits(f"{name} alone and with other channels", alone[name], together[name])
        if name in expected:
            worst.same(
                f"type and shape of {name}", (alone[name].dtype, tuple(alone[name].shape)), expected[name]
            )


def _refusals(renderer: Renderer, worst: Worst) -> None:
    scene, first_channel = sphere(), tuple(sorted(renderer.channels)[:1])
    wrong: dict[str, tuple[Scene, tuple[str, ...]]] = {
        "a channel that does not exist": (scene, ("colour of the wind",)),
        "faces beyond the vertices": (replace(scene, faces=scene.faces + len(scene.vertices)), first_channel),
        "negative faces": (replace(scene, faces=-scene.faces - 1), first_channel),
    }
    if "color" in renderer.channels:
        wrong["colour of a scene without colours"] = (replace(scene, colors=None), ("color",))
    for fault, (bad, channels) in wrong.items():
        try:
            renderer(bad, channels)
        except ValueError as error:
            worst.count(len(str(error)) < 10, f"{fault}: the error message is {error}")
        else:
            worst.count(True, f"{fault}: accepted, expected a ValueError")


def _repeatable(renderer: Renderer, worst: Worst) -> None:
    """Check that images of a scene are equal to the last bit after another scene was drawn."""
    first = renderer(sphere(), sorted(renderer.channels))
    renderer(square(2.0), sorted(renderer.channels))
    for name, again in renderer(sphere(), sorted(renderer.channels)).items():
        worst.same_bits(name, again, first[name])


def _no_faces(renderer: Renderer, worst: Worst) -> None:
    """Check that a scene without faces shows the background; rows of renderers of point sets leave this check out."""
    _check_background(renderer, empty(sphere()), "no faces", worst)


def _background(renderer: Renderer, worst: Worst) -> None:
    scene = sphere()
    away = torch.tensor([1e3, 1e3, 1e3])
    scenes = {
        "no vertices": replace(empty(scene), vertices=torch.zeros(0, 3), colors=torch.zeros(0, 3)),
        "behind the camera": square(-3.0),
        "out of view": replace(scene, vertices=scene.vertices + away),
        "nearer than the near plane": square(camera().near / 2, side=1e-4),
    }
    for situation, unseen in scenes.items():
        _check_background(renderer, unseen, situation, worst)


def _bad_triangles(renderer: Renderer, worst: Worst) -> None:
    scene = square(3.0)
    point = scene.vertices[:1].expand(4, 3)
    for shape, vertices in {
        "NaN": torch.full_like(scene.vertices, math.nan),
        "infinite": torch.full_like(scene.vertices, math.inf),
        "one point": point,
        "a line": scene.vertices[:1]
        + torch.arange(4.0)[:, None] * (scene.vertices[1:2] - scene.vertices[:1]) / 3,
    }.items():
        _check_background(renderer, replace(scene, vertices=vertices), shape, worst)
    # a bad triangle must not change the image of good ones
    mixed = replace(
        scene,
        vertices=torch.cat([scene.vertices, torch.tensor([[math.nan, 0, 0]])]),
        colors=None,
        faces=torch.cat([scene.faces, torch.tensor([[0, 1, 4]])]),
    )
    channels = sorted(renderer.channels - {"color"})
    good = renderer(replace(scene, colors=None), channels)
    for name, rendered in renderer(mixed, channels).items():
        worst.same_bits(f"{name} with an additional bad triangle", rendered, good[name])


def _check_background(renderer: Renderer, scene: Scene, situation: str, worst: Worst) -> None:
    rendered = renderer(scene, sorted(renderer.channels))
    background: dict[str, float] = {"depth": math.inf, "face": -1, "mask": 0}
    background |= {"normal": 0.0, "barycentric": 0.0, "uv": 0.0}
    for name, value in rendered.items():
        if name == "color":
            off = (value - renderer.background).abs()
            worst.record(
                off, f"color of a scene, {situation}: {value.flatten()[int(off.argmax())].item():.6g}"
            )
        elif name in background:
            worst.count(value != background[name], f"{name} of a scene, {situation}")


def _equal_faces(renderer: Renderer, worst: Worst) -> None:
    """Check that of several faces in the same position, the one with the lowest index is visible."""
    if "face" not in renderer.channels:
        worst.count(False, "the renderer does not draw face")
        return
    scene = square(3.0)
    doubled = replace(scene, faces=scene.faces.repeat(3, 1))
    face = renderer(doubled, ("face",))["face"]
    worst.count(~((face == 0) | (face == 1)), "pixels that do not show the first of three equal squares")


def _no_holes(renderer: Renderer, worst: Worst) -> None:
    """Check that a square of thousands of triangles that fills the view covers every pixel."""
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
        worst.count(~renderer(mesh, ("mask",))["mask"], "pixels of a closed surface that are not covered")
    elif "depth" in renderer.channels:
        worst.count(
            ~renderer(mesh, ("depth",))["depth"].isfinite(), "pixels of a closed surface that are not covered"
        )
    else:
        worst.count(False, "the renderer draws neither mask nor depth")


def _nearer_surface(renderer: Renderer, worst: Worst) -> None:
    if "face" not in renderer.channels:
        worst.count(False, "the renderer does not draw face")
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
    """Compare the depth of a sphere of many faces with ray intersections; the error is in metres.

    Pixels near the outline are left out.
    """
    if "depth" not in renderer.channels:
        worst.count(False, "the renderer does not draw depth")
        return
    scene = sphere(rings=72)
    depth = renderer(replace(scene, colors=None), ("depth",))["depth"].double()
    view = scene.camera
    y, x = torch.meshgrid(*[torch.arange(side, dtype=torch.float64) for side in SIZE], indexing="ij")
    ray = torch.stack(
        [
            (x - view.principal[0]) / view.focal[0],
            (y - view.principal[1]) / view.focal[1],
            torch.ones_like(x),
        ],
        -1,
    )
    centre = view.translation.double()  # centre of the sphere in camera coordinates
    along, square_of_ray = ray @ centre, ray.square().sum(-1)
    inside = along.square() - square_of_ray * (centre.square().sum() - 1)
    true = (along - inside.clamp(min=0).sqrt()) / square_of_ray
    clear = inside > 0.3 * inside.max()
    worst.record((depth - true).abs().where(clear, 0), lambda at: f"pixel {at}: {depth[at].item():.6g} m")


def _small_images(renderer: Renderer, worst: Worst) -> None:
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


def _projected_pixels(renderer: Renderer, worst: Worst) -> None:
    """Check that a triangle smaller than a pixel is drawn at the pixel and depth that `Camera.project` returns."""
    if "mask" not in renderer.channels:
        worst.count(False, "the renderer does not draw mask")
        return
    view = camera()
    focal, principal = (torch.tensor(part, dtype=torch.float64) for part in (view.focal, view.principal))
    around = torch.tensor([[-0.4, -0.3], [0.4, -0.3], [0.0, 0.45]], dtype=torch.float64)
    for row in range(3, SIZE[0], 7):
        for column in range(2, SIZE[1], 9):
            depth = 1.0 + (3 * row + column) % 5
            pixels = torch.tensor([column, row], dtype=torch.float64) + around
            inside = (
                torch.cat([(pixels - principal) / focal, torch.ones(3, 1, dtype=torch.float64)], -1) * depth
            )
            world = (inside - view.translation.double()) @ view.rotation.double()
            place, far = view.project(world)
            worst.count(
                bool((place - pixels).abs().max() > 1e-4),
                f"pixel {row, column}: Camera projects it to {place}",
            )
            worst.count(
                bool((far - depth).abs().max() > 1e-4),
                f"pixel {row, column}: Camera gives depth {far}, expected {depth}",
            )
            faces = torch.tensor([[0, 1, 2], [0, 2, 1]])  # visible from both sides
            mask = renderer(Scene(world.float(), faces, None, view), ("mask",))["mask"]
            drawn_pixels = mask.nonzero().tolist()
            worst.count(
                drawn_pixels != [[row, column]],
                f"pixel {row, column}: the triangle is drawn at {drawn_pixels}",
            )


def _near_plane(renderer: Renderer, worst: Worst) -> None:
    """Check the depth of a floor that extends behind the camera; the error is relative.

    The renderer may also leave the floor out.
    """
    if "depth" not in renderer.channels:
        worst.count(False, "the renderer does not draw depth")
        return
    view = replace(camera(), rotation=torch.eye(3), translation=torch.zeros(3), near=0.5)
    vertices = torch.tensor([[-90.0, 1, -50], [90, 1, -50], [90, 1, 50], [-90, 1, 50]])
    faces = torch.tensor([[0, 1, 2], [0, 2, 3], [2, 1, 0], [3, 2, 0]])
    depth = renderer(Scene(vertices, faces, None, view), ("depth",))["depth"].double()
    if not depth.isfinite().any():
        return
    down = (torch.arange(SIZE[0], dtype=torch.float64) - view.principal[1]) / view.focal[1]
    true = (1 / down).where(down > 0, math.inf)[:, None].expand(SIZE)
    clear = (true > 0.6) & (true < 40)
    off = (depth / true - 1).abs().nan_to_num(math.inf)
    worst.record(
        off.where(clear, 0),
        lambda at: f"pixel {at}: {depth[at].item():.6g} m, expected {true[at].item():.6g}",
    )
    worst.count(depth.isfinite() & (true > 60), "pixels that are drawn above the far end of the floor")
