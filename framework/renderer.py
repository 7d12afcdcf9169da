"""The contract of a renderer: a scene in, an image and only the channels asked for out."""

from abc import ABC, abstractmethod
from collections.abc import Collection
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float, Int
from torch import Tensor

from framework.geometry.camera import Camera


@dataclass(frozen=True)
class Scene:
    """Triangles seen by a pinhole camera.

    Attributes:
        vertices: world coordinates, metres.
        faces: three vertex indices per triangle, counter-clockwise seen from outside.
        colors: per vertex, linear in [0, 1], of one channel or more (red, green, blue; or 1 for a silhouette); None
            where no colour is asked for.
        camera: where from, and the image size.
    """

    vertices: Float[Tensor, "vertices 3"]
    faces: Int[Tensor, "faces 3"]
    colors: Float[Tensor, "vertices channels"] | None
    camera: Camera


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
    """What it can draw, of: "color" (height, width, channels) float32 in [0, 1], background 0; "depth" (height, width)
    float32, metres along the optical axis, background inf; "face" (height, width) int32, index of the visible
    face, background -1; "mask" (height, width) bool."""

    differentiable: ClassVar[frozenset[str]] = frozenset()
    """In what "color" has a gradient, that of pictures of areas and not of single points, of: "vertices", "colors",
    "rotation", "translation", "focal", "principal"."""

    @abstractmethod
    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        """The channels asked for, each once, keyed by name.

        Raises:
            ValueError: a channel it cannot draw, "color" of a scene without colours, or shapes and indices that do
                not fit; says what came and what was wanted.
        """
