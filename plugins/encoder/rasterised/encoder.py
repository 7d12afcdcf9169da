"""The rendered image of a registered mesh as features: a baseline, or the input of a learned renderer."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.bodies.people import load_body
from framework.bodies.topologies import Name, sheet, topology
from framework.configuration.paths import FilePath
from framework.data import Data
from framework.datasets import scan_layout
from framework.datasets.scan_layout import SubjectFolder
from framework.datasets.scan_textures import TEXELS, Textures
from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.geometry.camera import canonical_camera
from framework.geometry.clouds import sizes
from framework.geometry.mesh_files import COLOURS, XYZ
from framework.geometry.srgb import linear_from_srgb, srgb_from_linear
from framework.renderer import Renderer, Scene

COLUMNS = (*XYZ, *COLOURS)
Metres = Annotated[float, Field(gt=0, le=1e6)]


@dataclass(frozen=True, kw_only=True)
class Picture:
    """Settings of the rendered image.

    Attributes:
        height, width: size of the image, pixels.
        ground: whether a single channel replaces the colours: the share of each pixel that the mesh does not cover.
        depth: whether there is a further channel, 0 at `nearest` and 1 at `farthest` and beyond.
        nearest, farthest: range of the depth channel, metres from the camera.
    """

    height: Annotated[int, Field(ge=8, le=4096)] = 256
    width: Annotated[int, Field(ge=8, le=4096)] = 192
    ground: bool = False
    depth: bool = False
    nearest: Metres = 1.0
    farthest: Metres = 5.0


@dataclass(frozen=True, kw_only=True)
class MeshSettings:
    """Settings of the mesh whose vertices are the input, named as in `data=human_scans`.

    Attributes:
        topology: name of the mesh topology.
        root: folder of the data set; None if the meshes have the topology of the body model.
        body: file of the body model; None for the default body.
    """

    topology: Name = "7k"
    root: FilePath | None = None
    body: FilePath | None = None


class Rasterised(Encoder):
    """Rendered image of a registered body with vertex colours or a texture, on white, in the canonical camera.

    Inputs are the coloured vertices of `data=human_scans`, in the order of `mesh.topology`. Colours are interpolated
    and averaged in linear RGB. Textures lie in the folder of the data and are read when they are first drawn. Features
    are (3, height, width), sRGB numbers in [0, 1], in the inputs' dtype; with `depth` they are (4, height, width), like
    those of `encoder=projection`. A network can read these features instead of projected points. With `ground` the
    image is only the silhouette, black on white.

    Args:
        input_shape: (points, columns).
        input_columns: names of the columns, if the data name them.
        renderer: renderer that draws the mesh.
        textures: the data plugin `human_scans`, whose folder holds the textures of all subjects in the data; None to
            draw the vertex colours.
        picture, mesh: settings of the image and of the mesh.

    Raises:
        ConfigError: the input is not a cloud of coloured points, the renderer lacks a channel, `textures` is not
            `human_scans`, or the range of depths is empty.
        DataError: the mesh is not available; `forward` raises it if a texture is not available.
    """

    fixed = True
    bibtex = "kato2018neural"

    def __init__(
        self,
        input_shape: tuple[int, ...],
        input_columns: tuple[str, ...] = (),
        *,
        renderer: Renderer = "rasterizer",  # pyright: ignore[reportArgumentType]  # built by the framework
        textures: Data | None = None,
        picture: Picture,
        mesh: MeshSettings,
    ) -> None:
        super().__init__()
        if len(input_shape) != 2 or input_shape[1] < len(COLUMNS) or input_columns[:6] not in ((), COLUMNS):
            raise ConfigError(
                f"encoder rasterised got inputs of shape {input_shape}; expected (points, columns) whose first six "
                f"columns are {', '.join(COLUMNS)}. Choose data=human_scans, or another encoder."
            )
        if textures is not None and not isinstance(textures, SubjectFolder):
            raise ConfigError(
                f"encoder.rasterised.textures = {type(textures).__name__} has no textures; expected human_scans. "
                "Set textures=${data} if the data are human_scans, or textures=null."
            )
        if missing := {"color", "depth", *(["uv"] if textures else [])} - renderer.channels:
            raise ConfigError(
                f"encoder.rasterised.renderer = {type(renderer).__name__} does not draw the channels "
                f"{' and '.join(sorted(missing))}. Choose another renderer."
            )
        if not picture.nearest < picture.farthest:
            raise ConfigError(
                f"encoder rasterised got nearest={picture.nearest:g} and farthest={picture.farthest:g}, but nearest "
                "must be smaller than farthest. Set both, in metres from the camera, so that the subject is between "
                "them."
            )
        self.renderer = renderer
        self.people, self.topology = textures, mesh.topology
        self.textures: Textures | None = None
        self.camera = canonical_camera(picture.height, picture.width)
        self.ground, self.depth = picture.ground, picture.depth
        self.limits = (picture.nearest, picture.farthest)
        self.faces = load_faces(mesh)  # no buffer: meshes are drawn on the CPU on any device of the model
        self.output_shape = ((1 if picture.ground else 3) + picture.depth, picture.height, picture.width)

    @torch.no_grad()
    def forward(self, inputs: Float[Tensor, "batch points columns"]) -> Float[Tensor, "batch *features"]:
        sizes(inputs)  # raises DataError for inputs that are not clouds
        if len(inputs) and inputs.shape[1] <= int(self.faces.max()):
            raise DataError(
                f"Got a mesh of {inputs.shape[1]} vertices, but the topology has {int(self.faces.max()) + 1} vertices. "
                "Set encoder.rasterised.topology to the topology of the data."
            )
        scenes = [self._scene(cloud, row) for row, cloud in enumerate(inputs.cpu())]
        channels = ("color", "depth") if self.depth else ("color",)
        rendered = self.renderer.batch(scenes, channels)
        features = inputs.new_empty(len(inputs), *self.output_shape)
        for picture, channel_images in zip(features, rendered, strict=True):
            light, cover = channel_images["color"][..., :3], channel_images["color"][..., 3:]
            shown = 1 - cover if self.ground else srgb_from_linear(light + (1 - cover))
            picture[: shown.shape[-1]] = shown.movedim(-1, 0)
            if self.depth:
                nearest, farthest = self.limits
                picture[-1] = ((channel_images["depth"] - nearest) / (farthest - nearest)).clamp(0, 1)
        return features

    def _scene(self, cloud: Float[Tensor, "points columns"], row: int) -> Scene:
        """Return the scene that shows the mesh whose vertices are the points of a cloud; `row` is its row in the batch.

        Vertex colours have a fourth channel, which is 1 everywhere on the mesh, so that the render of this channel is
        the share of each pixel that the mesh covers.
        """
        vertices, colors = cloud[:, :3].float(), cloud[:, 3:6].float()
        if self.people is None:
            paint = torch.cat([linear_from_srgb(colors), colors.new_ones(len(colors), 1)], 1)
            return Scene(vertices, self.faces, paint, self.camera)
        if self.textures is None:
            longest = TEXELS * max(self.camera.height, self.camera.width)
            self.textures = Textures(self.people.place, self.topology, self.faces, longest)
        return Scene(vertices, self.faces, None, self.camera, self.textures.look_up(colors, row))


def load_faces(mesh: MeshSettings) -> Tensor:
    """Return the triangles of the mesh as vertex indices, (faces, 3).

    If `mesh.root` is set, the triangles are read from the registration of the first training subject in this folder.
    Otherwise they are those of the mesh topology `mesh.topology` of the body model.

    Raises:
        DataError: the body, or the meshes in the folder, are not available.
    """
    if mesh.root is None:
        chosen, _ = load_body(mesh.body)
        return torch.from_numpy(topology(chosen, sheet(chosen), mesh.topology).faces.copy()).int()
    folder = Path(mesh.root).expanduser()
    subject = scan_layout.read_splits(folder)["train"][0]
    file = folder / "subjects" / subject / f"registration_{mesh.topology}.ply"
    return scan_layout.read_registration(file).faces.int()
