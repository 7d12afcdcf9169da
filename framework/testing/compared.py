"""Checks of a renderer's images: against brute force, for batches of scenes and for sets of points."""

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace

import torch
from torch import Tensor

from framework.renderer import Renderer, Scene
from framework.testing.finding import SEED, Worst
from framework.testing.painted import wrapping
from framework.testing.ray_pictures import camera, crossing, floor, picture
from framework.testing.scenes import empty, sphere, square


def draws_points(renderer: Renderer) -> bool:
    """Return whether the renderer draws points, that is, whether it shows vertices that belong to no face."""
    if "color" not in renderer.channels:
        return False
    scene = empty(sphere())
    nothing = replace(scene, vertices=torch.zeros(0, 3), colors=torch.zeros(0, 3))
    drawn, ground = (renderer(one, ("color",))["color"] for one in (scene, nothing))
    return bool(((drawn - ground).abs() > 1e-3).any())


def _triangles(renderer: Renderer, channel: str, worst: Worst) -> bool:
    if channel not in renderer.channels or draws_points(renderer):
        worst.count(False, f"draws no {channel} of triangles")
        return False
    return True


def colors(renderer: Renderer, worst: Worst) -> None:
    """Check that colours are perspective-correct in all channels of the scene, and not rounded to bytes."""
    if not _triangles(renderer, "color", worst):
        return
    scenes = {
        "crossing triangles": crossing(),
        "a floor": floor(),
        "one channel": crossing((31, 34), 5, 1),
        "five channels": crossing((31, 34), 5, 5),
    }
    for what, scene in scenes.items():
        wanted, drawn = picture(scene), renderer(scene, ("color",))["color"].double()
        worst.same(f"{what}: shape", tuple(drawn.shape), tuple(wanted.color.shape))
        nothing = (wanted.face < 0)[..., None]
        off = (drawn - wanted.color.where(~nothing, renderer.background)).abs()
        said = f"{what}, pixel"
        worst.see(
            off.amax(-1).where(wanted.clear, 0),
            lambda at, said=said, drawn=drawn, wanted=wanted: (
                f"{said} {at}: {drawn[at].tolist()}, wanted {wanted.color[at].tolist()}"
            ),
        )
        levels = 255 * drawn[wanted.face >= 0]
        worst.count((levels - levels.round()).abs().amax() < 1e-3, f"{what}: colours are those of bytes")


def visibility(renderer: Renderer, worst: Worst) -> None:
    """Check that each pixel shows the nearest of several faces that intersect."""
    for channel in ("face", "mask"):
        if not _triangles(renderer, channel, worst):
            continue
        for what, scene in {"crossing triangles": crossing(), "a floor": floor()}.items():
            wanted = picture(scene)
            drawn = renderer(replace(scene, colors=None), (channel,))[channel]
            right = wanted.face if channel == "face" else wanted.face >= 0
            worst.count((drawn != right) & wanted.clear, f"{channel} of {what}: pixels")


def depth(renderer: Renderer, worst: Worst) -> None:
    """Check the depth along the optical axis, metres; the error is relative."""
    if not _triangles(renderer, "depth", worst):
        return
    for what, scene in {"crossing triangles": crossing(), "a floor": floor()}.items():
        wanted = picture(scene)
        drawn = renderer(replace(scene, colors=None), ("depth",))["depth"].double()
        equal = drawn == wanted.depth
        off = (drawn / wanted.depth - 1).abs().where(~equal, 0).nan_to_num(math.inf)
        worst.see(
            off.where(wanted.clear, 0),
            lambda at, what=what, drawn=drawn, wanted=wanted: (
                f"{what}, pixel {at}: {drawn[at].item():.6g} m, wanted {wanted.depth[at].item():.6g}"
            ),
        )


def several(renderer: Renderer, worst: Worst) -> None:
    """Check that a batch equals its scenes drawn one by one, whatever their order and sizes.

    Check also that faces may have any integer type, that drawing leaves a scene unchanged, and that the results of two
    calls share no memory.
    """
    scenes = [sphere(), square(2.0), replace(sphere(), camera=camera((33, 40))), square(5.0)]
    channels = sorted(renderer.channels)
    alone = [renderer(scene, channels) for scene in scenes]
    before = [[value.clone() for value in _tensors(scene)] for scene in scenes]
    together = renderer.batch(scenes, channels)
    worst.same("pictures of a batch", len(together), len(scenes))
    for number, (found, wanted) in enumerate(zip(together, alone, strict=False)):
        worst.same(f"channels of scene {number} of a batch", sorted(found), sorted(wanted))
        for name in found.keys() & wanted.keys():
            worst.same_bits(f"{name} of scene {number} of a batch", found[name], wanted[name])
    worst.same("pictures of no scene", list(renderer.batch([], channels)), [])
    for number, (scene, kept) in enumerate(zip(scenes, before, strict=True)):
        for value, old in zip(_tensors(scene), kept, strict=True):
            worst.same_bits(f"numbers of scene {number} afterwards", value, old)
    for name, found in renderer(replace(scenes[0], faces=scenes[0].faces.int()), channels).items():
        worst.same_bits(f"{name} of faces in int32", found, alone[0][name])
    for name, found in alone[0].items():
        again = renderer(scenes[1], (name,))[name]
        shared = found.untyped_storage().data_ptr() == again.untyped_storage().data_ptr()
        worst.count(shared, f"{name} of two calls is one memory")


def _tensors(scene: Scene) -> list[Tensor]:
    found = [getattr(part, field.name) for part in (scene, scene.camera) for field in fields(part)]
    return [value for value in found if isinstance(value, Tensor) and not is_dataclass(value)]


def color_gradient(renderer: Renderer, worst: Worst) -> None:
    """Check the gradient in vertex colours or texels against differences of two images, along a few directions.

    An image is linear in colours, so that the difference is exact up to rounding.
    """
    linear = sorted(renderer.differentiable & {"colors", "texture"})
    worst.count(False, "no gradient in colours")
    generator = torch.Generator().manual_seed(SEED)
    for name in linear:
        scene = sphere() if name == "texture" else crossing()
        assert scene.colors is not None
        scene = replace(scene, colors=0.2 + 0.6 * scene.colors)
        if name == "texture":
            scene = replace(scene, texture=wrapping(scene))
        given = scene.colors if scene.texture is None else scene.texture.images[0]
        assert given is not None
        given = given.double()
        weight = torch.randn(scene.camera.height, scene.camera.width, 3, generator=generator).double()
        for number in range(3):
            way = torch.randn(given.shape, generator=generator).double()
            if number:  # changes one number in ten, so that an error in a few of them shows
                way = way * (torch.rand(len(way), *[1] * (way.dim() - 1), generator=generator) < 0.1)
            step = torch.zeros((), dtype=torch.float64, requires_grad=True)
            total = (renderer(_colored(scene, given + step * way), ("color",))["color"] * weight).sum()
            (found,) = torch.autograd.grad(total, step)
            with torch.no_grad():
                ends = [
                    renderer(_colored(scene, given + sign * 0.02 * way), ("color",))["color"].double()
                    for sign in (1, -1)
                ]
            wanted = ((ends[0] - ends[1]) * weight).sum() / 0.04
            size = ((ends[0] - ends[1]) * weight).norm() / 0.04
            worst.see(
                (found - wanted).abs() / size.clamp(min=1e-9),
                f"{name}, direction {number}: {found.item():.6g}, by difference {wanted.item():.6g}",
            )


def _colored(scene: Scene, given: Tensor) -> Scene:
    if scene.texture is None:
        return replace(scene, colors=given)
    return replace(scene, texture=replace(scene.texture, images=(given,)))


def points(renderer: Renderer, worst: Worst) -> None:
    """Check that a renderer of points shows each at its pixel in its colour, and the nearer of two points there."""
    if not draws_points(renderer):
        worst.count(False, "draws no points")
        return
    far = torch.tensor([1.0, 1.0, 1.0]) if renderer.background == 0 else torch.tensor([0.0, 0.0, 0.0])
    for row, column in ((8, 11), (30, 44), (20, 29)):
        for near, behind in ((0, 2), (2, 1), (1, 0)):
            paint = [torch.zeros(3), torch.zeros(3)]
            for which, channel in enumerate((near, behind)):
                paint[which][:] = 1 - far
                paint[which][channel] = far[channel]
            drawn = _point_picture(renderer, row, column, [2.0, 6.0], paint)
            away = (drawn - renderer.background).abs().amax(-1)
            worst.count(away[row, column] < 0.1, f"nothing is seen at pixel {row, column}, where a point is")
            worst.count(
                (drawn[row, column] - paint[0]).norm() >= (drawn[row, column] - paint[1]).norm(),
                f"pixel {row, column}: {drawn[row, column].tolist()} of the nearer {paint[0].tolist()}",
            )
            far_off = away.clone()
            far_off[max(row - 12, 0) : row + 13, max(column - 12, 0) : column + 13] = 0
            worst.count(far_off > 0.1, f"pixels far from a point at {row, column}")


def _point_picture(
    renderer: Renderer, row: int, column: int, depths: Sequence[float], paint: Sequence[Tensor]
) -> Tensor:
    lens = camera((41, 58))
    focal, principal = (torch.as_tensor(part).double() for part in (lens.focal, lens.principal))
    ray = torch.cat([(torch.tensor([column, row]).double() - principal) / focal, torch.ones(1).double()])
    inside = torch.stack([ray * depth for depth in depths])
    world = (inside - lens.translation.double()) @ lens.rotation.double()
    faces = torch.zeros(0, 3, dtype=torch.int64)
    return renderer(Scene(world.float(), faces, torch.stack(list(paint)), lens), ("color",))["color"].double()
