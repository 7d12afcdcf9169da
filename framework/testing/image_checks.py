"""Checks of a renderer's images: against brute-force ray casting, for batches of scenes, and for sets of points.

Each check records its errors in `worst` (`framework.testing.finding.Worst`), which keeps the largest one.
"""

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace

import torch
from torch import Tensor

from framework.renderer import Renderer, Scene
from framework.testing.finding import SEED, Worst
from framework.testing.ray_images import camera, cast_image, crossing, floor
from framework.testing.scenes import empty, sphere, square
from framework.testing.surface_checks import smooth_texture


def draws_points(renderer: Renderer) -> bool:
    """Return true if the renderer draws points, that is, if vertices that belong to no face change the image."""
    if "color" not in renderer.channels:
        return False
    scene = empty(sphere())
    no_vertices = replace(scene, vertices=torch.zeros(0, 3), colors=torch.zeros(0, 3))
    with_vertices, without_vertices = (
        renderer(drawn_scene, ("color",))["color"] for drawn_scene in (scene, no_vertices)
    )
    return bool(((with_vertices - without_vertices).abs() > 1e-3).any())


def _draws_triangles(renderer: Renderer, channel: str, worst: Worst) -> bool:
    if channel not in renderer.channels or draws_points(renderer):
        worst.count(False, f"the renderer does not draw {channel} of triangles")
        return False
    return True


def colors(renderer: Renderer, worst: Worst) -> None:
    """Check that colours are interpolated with perspective, in all colour channels, and are not rounded to bytes."""
    if not _draws_triangles(renderer, "color", worst):
        return
    scenes = {
        "crossing triangles": crossing(),
        "a floor": floor(),
        "one channel": crossing((31, 34), 5, 1),
        "five channels": crossing((31, 34), 5, 5),
    }
    for scene_name, scene in scenes.items():
        expected, rendered = cast_image(scene), renderer(scene, ("color",))["color"].double()
        worst.same(f"{scene_name}: shape", tuple(rendered.shape), tuple(expected.color.shape))
        nothing = (expected.face < 0)[..., None]
        off = (rendered - expected.color.where(~nothing, renderer.background)).abs()
        prefix = f"{scene_name}, pixel"
        worst.record(
            off.amax(-1).where(expected.clear, 0),
            lambda at, prefix=prefix, rendered=rendered, expected=expected: (
                f"{prefix} {at}: {rendered[at].tolist()}, expected {expected.color[at].tolist()}"
            ),
        )
        levels = 255 * rendered[expected.face >= 0]
        worst.count(
            (levels - levels.round()).abs().amax() < 1e-3, f"{scene_name}: all colours are multiples of 1/255"
        )


def visibility(renderer: Renderer, worst: Worst) -> None:
    """Check that each pixel shows the nearest of several faces that intersect."""
    for channel in ("face", "mask"):
        if not _draws_triangles(renderer, channel, worst):
            continue
        for scene_name, scene in {"crossing triangles": crossing(), "a floor": floor()}.items():
            expected = cast_image(scene)
            rendered = renderer(replace(scene, colors=None), (channel,))[channel]
            right = expected.face if channel == "face" else expected.face >= 0
            worst.count((rendered != right) & expected.clear, f"{scene_name}: pixels with a wrong {channel}")


def depth(renderer: Renderer, worst: Worst) -> None:
    """Check the depth along the optical axis; the error is relative."""
    if not _draws_triangles(renderer, "depth", worst):
        return
    for scene_name, scene in {"crossing triangles": crossing(), "a floor": floor()}.items():
        expected = cast_image(scene)
        rendered = renderer(replace(scene, colors=None), ("depth",))["depth"].double()
        equal = rendered == expected.depth
        off = (rendered / expected.depth - 1).abs().where(~equal, 0).nan_to_num(math.inf)
        worst.record(
            off.where(expected.clear, 0),
            lambda at, scene_name=scene_name, rendered=rendered, expected=expected: (
                f"{scene_name}, pixel {at}: {rendered[at].item():.6g} m, expected {expected.depth[at].item():.6g}"
            ),
        )


def scene_batches(renderer: Renderer, worst: Worst) -> None:
    """Check that scenes of different sizes give the same images in a batch as one by one.

    Check also that faces may be int32, that a scene is unchanged after it was drawn, and that the results of two calls
    share no memory.
    """
    scenes = [sphere(), square(2.0), replace(sphere(), camera=camera((33, 40))), square(5.0)]
    channels = sorted(renderer.channels)
    alone = [renderer(scene, channels) for scene in scenes]
    before = [[value.clone() for value in _tensors(scene)] for scene in scenes]
    together = renderer.batch(scenes, channels)
    worst.same("number of images of a batch", len(together), len(scenes))
    for number, (rendered, expected) in enumerate(zip(together, alone, strict=False)):
        worst.same(f"channels of scene {number} of a batch", sorted(rendered), sorted(expected))
        for name in rendered.keys() & expected.keys():
            worst.same_bits(f"{name} of scene {number} of a batch", rendered[name], expected[name])
    worst.same("images of an empty batch", list(renderer.batch([], channels)), [])
    for number, (scene, originals) in enumerate(zip(scenes, before, strict=True)):
        for value, old in zip(_tensors(scene), originals, strict=True):
            worst.same_bits(f"tensors of scene {number} after it was drawn", value, old)
    for name, rendered in renderer(replace(scenes[0], faces=scenes[0].faces.int()), channels).items():
        worst.same_bits(f"{name} with faces in int32", rendered, alone[0][name])
    for name, rendered in alone[0].items():
        second = renderer(scenes[1], (name,))[name]
        shared = rendered.untyped_storage().data_ptr() == second.untyped_storage().data_ptr()
        worst.count(shared, f"{name} of two calls shares memory")


def _tensors(scene: Scene) -> list[Tensor]:
    values = [getattr(part, field.name) for part in (scene, scene.camera) for field in fields(part)]
    return [value for value in values if isinstance(value, Tensor) and not is_dataclass(value)]


def color_gradient(renderer: Renderer, worst: Worst) -> None:
    """Check the gradient in vertex colours and in texels against central differences, along a few random directions.

    An image is linear in colours, so that central differences are exact up to rounding.
    """
    linear = sorted(renderer.differentiable & {"colors", "texture"})
    worst.count(False, "the renderer has no gradient in colours")
    generator = torch.Generator().manual_seed(SEED)
    for name in linear:
        scene = sphere() if name == "texture" else crossing()
        assert scene.colors is not None
        scene = replace(scene, colors=0.2 + 0.6 * scene.colors)
        if name == "texture":
            scene = replace(scene, texture=smooth_texture(scene))
        colors = scene.colors if scene.texture is None else scene.texture.images[0]
        assert colors is not None
        colors = colors.double()
        weight = torch.randn(scene.camera.height, scene.camera.width, 3, generator=generator).double()
        for number in range(3):
            direction = torch.randn(colors.shape, generator=generator).double()
            if number:  # changes one colour in ten, so that an error in a few of them shows
                direction = direction * (
                    torch.rand(len(direction), *[1] * (direction.dim() - 1), generator=generator) < 0.1
                )
            step = torch.zeros((), dtype=torch.float64, requires_grad=True)
            total = (
                renderer(_with_colors(scene, colors + step * direction), ("color",))["color"] * weight
            ).sum()
            (analytic,) = torch.autograd.grad(total, step)
            with torch.no_grad():
                ends = [
                    renderer(_with_colors(scene, colors + sign * 0.02 * direction), ("color",))[
                        "color"
                    ].double()
                    for sign in (1, -1)
                ]
            numeric = ((ends[0] - ends[1]) * weight).sum() / 0.04
            size = ((ends[0] - ends[1]) * weight).norm() / 0.04
            worst.record(
                (analytic - numeric).abs() / size.clamp(min=1e-9),
                f"{name}, direction {number}: {analytic.item():.6g}, by differences {numeric.item():.6g}",
            )


def _with_colors(scene: Scene, colors: Tensor) -> Scene:
    if scene.texture is None:
        return replace(scene, colors=colors)
    return replace(scene, texture=replace(scene.texture, images=(colors,)))


def points(renderer: Renderer, worst: Worst) -> None:
    """Check that a renderer of points draws a point at its pixel, and the colour of the nearer of two points there."""
    if not draws_points(renderer):
        worst.count(False, "the renderer draws no points")
        return
    contrast = torch.tensor([1.0, 1.0, 1.0]) if renderer.background == 0 else torch.tensor([0.0, 0.0, 0.0])
    for row, column in ((8, 11), (30, 44), (20, 29)):
        for near, behind in ((0, 2), (2, 1), (1, 0)):
            point_colors = [torch.zeros(3), torch.zeros(3)]
            for which, channel in enumerate((near, behind)):
                point_colors[which][:] = 1 - contrast
                point_colors[which][channel] = contrast[channel]
            rendered = _render_points(renderer, row, column, [2.0, 6.0], point_colors)
            difference = (rendered - renderer.background).abs().amax(-1)
            worst.count(
                difference[row, column] < 0.1, f"pixel {row, column} shows the background, expected a point"
            )
            worst.count(
                (rendered[row, column] - point_colors[0]).norm()
                >= (rendered[row, column] - point_colors[1]).norm(),
                f"pixel {row, column}: {rendered[row, column].tolist()}, expected {point_colors[0].tolist()}, the "
                "colour of the nearer point",
            )
            elsewhere = difference.clone()
            elsewhere[max(row - 12, 0) : row + 13, max(column - 12, 0) : column + 13] = 0
            worst.count(elsewhere > 0.1, f"pixels changed far from the point at {row, column}")


def _render_points(
    renderer: Renderer, row: int, column: int, depths: Sequence[float], point_colors: Sequence[Tensor]
) -> Tensor:
    lens = camera((41, 58))
    focal, principal = (torch.as_tensor(part).double() for part in (lens.focal, lens.principal))
    ray = torch.cat([(torch.tensor([column, row]).double() - principal) / focal, torch.ones(1).double()])
    inside = torch.stack([ray * depth for depth in depths])
    world = (inside - lens.translation.double()) @ lens.rotation.double()
    faces = torch.zeros(0, 3, dtype=torch.int64)
    return renderer(Scene(world.float(), faces, torch.stack(list(point_colors)), lens), ("color",))[
        "color"
    ].double()
