"""The contract of a renderer: a scene in, an image and only the channels asked for out."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry.camera import Camera

Wrap = Literal["repeat", "clamp", "mirror"]


@dataclass(frozen=True)
class Texture:
    """Pictures laid onto faces.

    Attributes:
        images: linear in [0, 1], rows from top to bottom, of any sizes, all of as many channels.
        uv: places in an image, u to the right and v upwards: (0, 0) is its lower left corner, (1, 1) its upper right.
        faces: three rows of `uv` per triangle of the scene.
        shown: which of the images each face shows, -1 for none; None: all show the first.
        wrap: what lies beyond the image.
        smooth: interpolate between the centres of texels; else the texel that a place lies in.
    """

    images: tuple[Float[Tensor, "_height _width channels"], ...]
    uv: Float[Tensor, "places 2"]
    faces: Int[Tensor, "faces 3"]
    shown: Int[Tensor, "faces"] | None = None
    wrap: Wrap = "repeat"
    smooth: bool = True


@dataclass(frozen=True)
class Scene:
    """Triangles seen by a pinhole camera.

    Attributes:
        vertices: world coordinates, metres.
        faces: three vertex indices per triangle, counter-clockwise seen from outside; none in a set of points.
        colors: per vertex, linear in [0, 1], of one channel or more (red, green, blue; or 1 for a silhouette); None
            where no colour is asked for, or the texture says it all.
        camera: where from, and the image size.
        texture: what faces show; where there are colours too, the product of both.
    """

    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    colors: Float[Tensor, "vertices channels"] | None
    camera: Camera
    texture: Texture | None = None


@dataclass(frozen=True)
class Report:
    """What one picture left out, and what was left to do.

    Attributes:
        faces: of the scene.
        drawn: faces whose pixels were visited.
        left_out: the other faces by the first reason that held: "outside" (no pixel centre of the image in the box
            around it), "behind" (the near plane), "back" (seen from behind), "flat" (no area, or not finite),
            "hidden" (behind what was drawn before); a reason that held for none is absent.
        visited: pixels of the box around what was drawn; the others were not looked at again.
        reused: what was kept from the last picture, since it had not changed: "places" of vertices on the screen, say.
        channels: those that were drawn.
    """

    faces: int
    drawn: int
    left_out: Mapping[str, int]
    visited: int
    reused: frozenset[str]
    channels: frozenset[str]


def joined(scenes: Sequence[Scene]) -> Scene:
    """Several subjects in one scene, seen by the camera of the first; vertices and faces in the order they came.

    A subject without colours has white ones where another has some.

    Raises:
        ValueError: no scene came, colours differ in channels, or textures in `wrap` or `smooth`.
    """
    if not scenes:
        raise ValueError("no scene came; wanted one or more to join.")
    paints = [scene.colors for scene in scenes if scene.colors is not None]
    paints += [image for scene in scenes if scene.texture is not None for image in scene.texture.images]
    if len({paint.shape[-1] for paint in paints}) > 1:
        raise ValueError(
            f"colours came with {' and '.join(sorted({str(paint.shape[-1]) for paint in paints}))} channels; wanted as "
            "many in all scenes."
        )
    counts = [len(scene.vertices) for scene in scenes]
    first = accumulate(counts[:-1], initial=0)
    faces = [_moved(scene.faces, start) for scene, start in zip(scenes, first, strict=True)]
    colors = None
    if any(scene.colors is not None for scene in scenes):
        channels = next(scene.colors.shape[1] for scene in scenes if scene.colors is not None)
        white = [scene.vertices.new_ones(len(scene.vertices), channels) for scene in scenes]
        colors = torch.cat(
            [
                one if (given := scene.colors) is None else given
                for scene, one in zip(scenes, white, strict=True)
            ]
        )
    vertices = torch.cat([scene.vertices for scene in scenes])
    return Scene(vertices, torch.cat(faces), colors, scenes[0].camera, _joined_textures(scenes))


def _moved(indices: Tensor, by: int) -> Tensor:
    """Indices that count from elsewhere. Types that hold them may not hold their sum: 200 + 100 is 44 in uint8."""
    return (indices if indices.is_floating_point() else indices.long()) + by


def _joined_textures(scenes: Sequence[Scene]) -> Texture | None:
    textures = [scene.texture for scene in scenes if scene.texture is not None]
    if not textures:
        return None
    if len({(texture.wrap, texture.smooth) for texture in textures}) > 1:
        raise ValueError(
            "textures came with different wrap or smooth; wanted the same in one scene: draw them apart, or change one."
        )
    images: list[Tensor] = []
    places, faces, shown = [], [], []
    corners = 0
    for scene in scenes:
        texture = scene.texture
        if texture is None:
            faces.append(torch.zeros_like(scene.faces, dtype=torch.int64))
            shown.append(scene.faces.new_full((len(scene.faces),), -1, dtype=torch.int64))
            continue
        of_faces = texture.faces.new_zeros(len(texture.faces)) if texture.shown is None else texture.shown
        shown.append(torch.where(of_faces < 0, of_faces, _moved(of_faces, len(images))))
        faces.append(_moved(texture.faces, corners))
        places.append(texture.uv)
        images += texture.images
        corners += len(texture.uv)
    one = textures[0]
    return Texture(tuple(images), torch.cat(places), torch.cat(faces), torch.cat(shown), one.wrap, one.smooth)


class Renderer(ABC):
    """Draws scenes; draws only what is asked for and what the camera can see.

    Keyword-only constructor parameters are the config. A renderer has no state that one call leaves for the next
    (buffers it reuses are its own affair), so that calls may come in any order. A triangle with a coordinate that is
    not finite or no area (at the renderer's own precision) is left out, never drawn wrong; of one that the near plane
    cuts, what is beyond is drawn, or nothing; a scene out of view gives the background. Where two surfaces are equally
    far, the lower face index wins.

    "color" may have a gradient in what of the scene requires one: `differentiable` says in what it has.
    """

    group: ClassVar[str] = "renderer"
    bibtex: ClassVar[str]
    """What to cite, as BibTeX."""
    channels: ClassVar[frozenset[str]]
    """What it can draw, each (height, width) or, with a number behind it here, (height, width, number): "color" of as
    many as the scene's, float32 in [0, 1]; "depth", float32, metres along the optical axis, background
    inf; "face", int32, index of the visible face, background -1; "mask", bool; "normal" 3, float32, of the visible
    face, of length 1, in world axes, to the side from which its corners run counter-clockwise; "barycentric" 3,
    float32, weights of its corners, perspective-correct; "uv" 2, float32, where in its texture, before wrapping, 0
    where it has none; the background of the last three is 0. One that does not draw "uv" refuses "color" of a scene
    with a texture."""

    background: ClassVar[float] = 0.0
    """What "color" is where nothing is seen, in every channel: 0, or 1 of one that paints on white."""

    differentiable: frozenset[str] = frozenset()
    """In what "color" has a gradient, that of pictures of areas and not of single points, of: "vertices", "colors",
    "texture" (its images), "uv", "rotation", "translation", "focal", "principal"."""

    report: Report | None = None
    """Of the last picture; None where it keeps none."""

    def batch(
        self, scenes: Sequence[Scene], channels: Collection[str] = ("color",)
    ) -> list[dict[str, Tensor]]:
        """The same of several scenes, of any sizes; a renderer may draw them side by side."""
        return [self(scene, channels) for scene in scenes]

    @abstractmethod
    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        """The channels asked for, each once, keyed by name.

        Raises:
            ValueError: a channel it cannot draw, "color" of a scene without colours, or shapes and indices that do
                not fit; says what came and what was wanted.
        """
