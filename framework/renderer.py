"""The contract of a renderer: a scene comes in, and an image with only the requested channels goes out."""

from abc import ABC, abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from itertools import accumulate
from typing import ClassVar, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from framework.data import Batch
from framework.geometry.camera import Camera

Wrap = Literal["repeat", "clamp", "mirror"]
"""Rules for the colour of a texture beyond its image."""


@dataclass(frozen=True)
class Texture:
    """Images that are laid onto faces.

    Attributes:
        images: linear in [0, 1], rows from top to bottom; their sizes may differ, their numbers of channels may not.
        uv: positions in an image, u to the right and v upwards: (0, 0) is its lower left corner, (1, 1) its upper
            right.
        faces: for each triangle of the scene, the rows of `uv` that hold the positions of its three corners.
        shown: index of the image on each face, -1 for none; None puts the first image on all faces.
        wrap: rule for positions beyond the image.
        smooth: True interpolates between the centres of texels; False takes the texel that holds the position.
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
        faces: three vertex indices per triangle, counter-clockwise seen from outside; a set of points has no faces.
        colors: colour of each vertex, linear in [0, 1], with one or more channels (red, green, blue; or 1 for a
            silhouette). None if no colour is requested, or if the texture alone gives the colour.
        camera: camera pose, intrinsics and image size.
        texture: texture of the faces. If there are vertex colours too, the image shows the product of both.
    """

    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    colors: Float[Tensor, "vertices channels"] | None
    camera: Camera
    texture: Texture | None = None


@dataclass(frozen=True)
class Report:
    """Counts of what the renderer drew, left out and reused for one image.

    Attributes:
        faces: number of faces of the scene.
        drawn_faces: number of faces whose pixels were visited.
        left_out: number of the other faces by the first reason that held: "outside" (the box around the face holds no
            pixel centre of the image), "behind" (the near plane), "back" (seen from behind), "flat" (no area, or not
            finite), "hidden" (behind faces that were drawn before). A reason that held for no face is absent.
        visited: number of pixels in the rectangle for which channels were computed. The rectangle holds all drawn
            faces; the pixels outside of the rectangle keep the background.
        reused: names of results that were kept from the last image because they had not changed, such as "places" of
            vertices on the screen.
        channels: names of the channels that were drawn.
    """

    faces: int
    drawn_faces: int
    left_out: Mapping[str, int]
    visited: int
    reused: frozenset[str]
    channels: frozenset[str]


def join_scenes(scenes: Sequence[Scene]) -> Scene:
    """Return several scenes as one scene, seen by the camera of the first; vertices and faces keep their order.

    A scene without colours gets white ones if another scene has colours.

    Raises:
        ValueError: there is no scene; or colours differ in their number of channels; or textures differ in `wrap` or
            `smooth`.
    """
    if not scenes:
        raise ValueError("Got no scene to join; expected at least one scene. Give a scene.")
    paints = [scene.colors for scene in scenes if scene.colors is not None]
    paints += [image for scene in scenes if scene.texture is not None for image in scene.texture.images]
    if len({paint.shape[-1] for paint in paints}) > 1:
        raise ValueError(
            f"The scenes have colours with {' and '.join(sorted({str(paint.shape[-1]) for paint in paints}))} "
            "channels; expected the same number of channels in all scenes."
        )
    counts = [len(scene.vertices) for scene in scenes]
    first = accumulate(counts[:-1], initial=0)
    faces = [_add_offset(scene.faces, start) for scene, start in zip(scenes, first, strict=True)]
    colors = None
    if any(scene.colors is not None for scene in scenes):
        channels = next(scene.colors.shape[1] for scene in scenes if scene.colors is not None)
        white = [scene.vertices.new_ones(len(scene.vertices), channels) for scene in scenes]
        colors = torch.cat(
            [
                white_colors if scene.colors is None else scene.colors
                for scene, white_colors in zip(scenes, white, strict=True)
            ]
        )
    vertices = torch.cat([scene.vertices for scene in scenes])
    return Scene(vertices, torch.cat(faces), colors, scenes[0].camera, _join_textures(scenes))


def _add_offset(indices: Tensor, by: int) -> Tensor:
    """Return indices plus an offset. Small integer types become int64, since 200 + 100 is 44 in uint8."""
    return (indices if indices.is_floating_point() else indices.long()) + by


def _join_textures(scenes: Sequence[Scene]) -> Texture | None:
    """Return one texture for the joined faces of several scenes, or None if no scene has a texture."""
    textures = [scene.texture for scene in scenes if scene.texture is not None]
    if not textures:
        return None
    if len({(texture.wrap, texture.smooth) for texture in textures}) > 1:
        raise ValueError(
            "The textures of the scenes differ in `wrap` or `smooth`, but the joined scene has only one value of "
            "each. Draw the scenes separately, or give all textures the same values."
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
        shown.append(torch.where(of_faces < 0, of_faces, _add_offset(of_faces, len(images))))
        faces.append(_add_offset(texture.faces, corners))
        places.append(texture.uv)
        images += texture.images
        corners += len(texture.uv)
    first_texture = textures[0]
    return Texture(
        tuple(images),
        torch.cat(places),
        torch.cat(faces),
        torch.cat(shown),
        first_texture.wrap,
        first_texture.smooth,
    )


class Renderer(ABC):
    """Base class of renderers, which draw the requested channels of a scene, and only what the camera can see.

    Keyword-only constructor parameters are the config. No call changes the result of a later one (a renderer may reuse
    buffers), so calls may come in any order.

    A triangle with a coordinate that is not finite, or without area at the renderer's own precision, is left out and
    never drawn wrongly. If the near plane cuts a triangle, the part beyond the plane is drawn, or nothing. A scene out
    of view gives the background. If two surfaces are equally far, the lower face index wins.

    "color" may have a gradient in those parts of the scene that require one; `differentiable` lists the supported
    parts.
    """

    group: ClassVar[str] = "renderer"
    bibtex: ClassVar[str]
    """Citation of the method: BibTeX entries, or their keys in the `references.bib` of the package; "" for none."""
    channels: ClassVar[frozenset[str]]
    """Names of the channels that the renderer can draw.

    Each channel is (height, width) or, with several numbers, (height, width, number).

    - "color": as many numbers as the scene's colours, float32 in [0, 1].
    - "depth": float32, metres along the optical axis; background inf.
    - "face": int32, index of the visible face; background -1.
    - "mask": bool, true where a face is visible.
    - "normal": 3 numbers, float32, unit normal of the visible face in world axes, to the side from which its corners
    run counter-clockwise.
    - "barycentric": 3 numbers, float32, perspective-correct weights of the face's corners.
    - "uv": 2 numbers, float32, position in the face's texture before wrapping, 0 on a face without a texture.

    The background of the last three is 0. A renderer that does not draw "uv" refuses "color" of a scene with a texture.
    """

    background: ClassVar[float] = 0.0
    """Value of "color" in every channel where nothing is seen: 0, or 1 for a renderer that draws on white."""

    differentiable: frozenset[str] = frozenset()
    """Names of the scene's parts in which "color" has a gradient.

    The names are "vertices", "colors", "texture" (its images), "uv", "rotation", "translation", "focal" and
    "principal". The gradient is that of an image whose pixels are averages over their areas, not samples at single
    points.
    """

    report: Report | None = None
    """Report on the last image; None if the renderer keeps none."""

    parameters: int = 0
    """Number of trained parameters; 0 for a renderer that learns nothing."""

    def batch(
        self, scenes: Sequence[Scene], channels: Collection[str] = ("color",)
    ) -> list[dict[str, Tensor]]:
        """Draw several scenes, which may differ in size, and return the channels of each.

        A renderer may draw them in parallel.
        """
        return [self(scene, channels) for scene in scenes]

    @abstractmethod
    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        """Draw the requested channels of a scene, each once, and return them by name.

        Raises:
            ValueError: the renderer cannot draw a channel; or "color" is requested of a scene without colours; or
                shapes or indices do not fit. The message says what the renderer got and what it requires.
        """


class TrainedRenderer(Renderer):
    """Additional contract of a renderer that draws with the trained model of a run.

    The keyword-only parameters of its constructor include these two:

    - checkpoint: folder of the run, or its checkpoint file; None if there is no trained model yet. `mode=render` then
      trains the model of its config first, and names its own run folder here.
    - paths: files and folders that the run's config names, by dotted key. A stored path is opened only if it is
      repeated here.
    """


class HasScenes(ABC):
    """Additional base class of a data set whose test images show known scenes, which `mode=render` draws again.

    The batches hold the true images in the fields "color", "mask" or "depth" (`framework.data.Batch`).
    """

    surfaces: ClassVar[tuple[str, ...]] = ("colors",)
    """Kinds of surfaces that the scenes can have, the default first.

    The names are "colors", for colours of vertices, and "textures".
    """

    ground: ClassVar[float] = 1.0
    """Linear RGB value of the true images where no subject is seen: 0 for black, 1 for white."""

    @abstractmethod
    def scenes(self, batch: Batch, surface: str) -> list[Scene]:
        """Return the scenes of a batch of the test split, on the CPU; works after `Data.prepare`.

        Colours have four channels: red, green, blue, and 1 everywhere, whose render is the share of each pixel that the
        surface covers.

        Args:
            batch: batch of the test split.
            surface: one of `surfaces`.

        Raises:
            DataError: the surface of a scene cannot be read.
        """
