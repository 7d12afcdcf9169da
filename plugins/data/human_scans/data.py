"""Data set `human_scans`: photographs of scanned people, with registered meshes of one colour per vertex."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.utils.data import Dataset

from framework.configuration.paths import FilePath
from framework.data import Batch, Data, Splits
from framework.datasets import scan_layout
from framework.datasets.fields import Fields
from framework.datasets.scan_layout import Subject, SubjectFolder, View
from framework.datasets.scan_textures import TEXELS, Textures
from framework.errors import ConfigError, DataError, shorten
from framework.geometry import clouds
from framework.geometry.camera import Camera, canonical_camera
from framework.geometry.mesh_files import COLOURS, XYZ
from framework.geometry.meshes import READERS, read
from framework.geometry.srgb import linear_from_bytes, linear_from_srgb, srgb_from_linear
from framework.renderer import HasScenes, Renderer, Scene
from framework.storage.generated import read_mark
from framework.storage.limits import MOST_INPUT
from framework.target import Target
from plugins.data.human_scans.scan_generator import Crowd, Drawing, scans_root

VERSION = 1
"""Version of the reading code, part of the fingerprint; increase it if the data that are read change."""
Number = Annotated[int, Field(ge=1, le=100_000)]
Seed = Annotated[int, Field(ge=0, lt=2**31)]
Shows = Literal["photograph", "subject"]
Word = Annotated[str, Field(pattern=r"^[A-Za-z0-9._-]{1,40}$")]


@dataclass(frozen=True, kw_only=True)
class Counts:
    """Number of generated subjects of each split."""

    train: Number = 40
    validation: Number = 4
    test: Number = 8


@dataclass(frozen=True, kw_only=True)
class Variation:
    """Random changes of the training images.

    Attributes:
        mirrored: whether half of the training samples are mirrored, both the points and the photograph.
        recoloured: share of the training samples whose red, green and blue are permuted, in the points and in the
            photograph. This is plausible, because the light is white and clothes have any colour.
    """

    mirrored: bool = True
    recoloured: Annotated[float, Field(ge=0, le=1)] = 0.5


class HumanScans(Data, SubjectFolder, HasScenes):
    """Photographs of people, each with the mesh registered to the person's scan (thesis §7.3.1, §7.4.1).

    An input is (points, 6): each vertex in the axes of the canonical camera of the image
    (`framework.geometry.camera.canonical_camera`: x right, y down, z forward, metres) and its red, green and blue as
    files hold them, sRGB in [0, 1]. The target is the photograph, (height, width, 3), sRGB in [0, 1], composited on
    white with its mask in linear RGB. Batches also hold "color", the photograph in linear RGB; "mask" (height, width),
    bool, true for pixels that the subject covers by half or more; "subject", int64, the subject's number in the split.

    Args:
        renderer: draws the photographs of generated people.
        root: a folder in the layout of framework.datasets.scan_layout; None: people are generated into the cache once.
        topology: name of the registered meshes to read; 7k (6,890 vertices) and 27k (27,578) are generated.
        shows: kind of the target. "photograph": the photograph. "subject": the segmentation (thesis §7.3.1), one number
            per pixel, which is 1 if the subject covers half of the pixel or more, and 0 otherwise.
        counts, drawing: settings of generated people.
        data_seed: seed of the draws of generated people, independent of the seed of the run.
        variation: random changes of the training images.

    Raises:
        DataError: a file is missing or damaged, images differ in size, or meshes differ in their number of vertices.
        ConfigError: the renderer draws no colours, or the topology is not generated.
    """

    bibtex = "prokudin2021smplpix, bregier2026anny"
    suffixes = tuple(READERS)
    columns = (*XYZ, *COLOURS)
    surfaces = ("colors", "textures")

    def __init__(
        self,
        *,
        renderer: Renderer = "rasterizer",  # pyright: ignore[reportArgumentType]  # built by the framework
        root: FilePath | None = None,
        topology: Word = "7k",
        shows: Shows = "photograph",
        counts: Counts,
        drawing: Drawing,
        data_seed: Seed = 0,
        variation: Variation,
    ) -> None:
        if "color" not in renderer.channels or renderer.background:
            raise ConfigError(
                f"data.renderer = {type(renderer).__name__} does not draw the channel `color` with a black "
                "background, which this data set requires. Choose another renderer, such as rasterizer with its "
                "default background."
            )
        self.renderer = renderer
        self.root = root
        self.topology = topology
        self.shows: Shows = shows
        self.counts = asdict(counts)
        self.drawing = drawing
        self.data_seed = data_seed
        self.variation = variation
        self.varies = variation.mirrored or variation.recoloured > 0
        self.size = (drawing.height, drawing.width)

    @property
    def place(self) -> Path:
        """Return the folder of the data set; it may not exist yet.

        Raises:
            DataError: the body or the skins of generated people are not available.
            ConfigError: the settings of generated people do not fit together.
        """
        if self.root is not None:
            return Path(self.root).expanduser()
        return Crowd(self.renderer, self.counts, self.drawing, self.data_seed).root

    def check_files(self) -> None:
        if self.root is not None:
            scan_layout.read_splits(self.place)

    def prepare(self) -> None:
        if self.root is None:
            if self.topology not in self.drawing.topologies:
                raise ConfigError(
                    f"data.topology = {self.topology} is not one of data.topologies = "
                    f"[{', '.join(self.drawing.topologies)}], which are generated. Add the topology to data.topologies."
                )
            root = scans_root(self.renderer, self.counts, self.drawing, self.data_seed)
        else:
            root = self.place
        self.folder = root
        self._textures: Textures | None = None
        self.groups = ("people",)
        self.synthetic = read_mark(root) is not None
        self.skipped = 0
        names = scan_layout.read_splits(root)
        subjects = {
            split: [scan_layout.read_subject(root, name, self.topology) for name in some]
            for split, some in names.items()
        }
        every = [subject for some in subjects.values() for subject in some]
        self.size, points = _common_size(root, every)
        self.input_shape = (points, len(self.columns))
        channels = COLOURS if self.shows == "photograph" else (self.shows,)
        self.target = Target("image", channels, size=self.size)
        self._digest = _digest(subjects)
        self._splits = Splits(**{split: Photographs(some, self.shows) for split, some in subjects.items()})

    def splits(self) -> Splits:
        return self._splits

    def scenes(self, batch: Batch, surface: str) -> list[Scene]:
        people, camera = self._splits.test.subjects, canonical_camera(*self.size)  # type: ignore[attr-defined]
        scenes = []
        for row, (cloud, number) in enumerate(zip(batch["input"], batch["subject"].tolist(), strict=True)):
            vertices, colors = cloud[:, :3], cloud[:, 3:6]
            faces = people[number].mesh.faces.int()
            if surface == "textures":
                if self._textures is None:
                    longest = TEXELS * max(self.size)
                    self._textures = Textures(self.folder, self.topology, faces, longest)
                scenes.append(Scene(vertices, faces, None, camera, self._textures.look_up(colors, row)))
            else:
                paint = torch.cat([linear_from_srgb(colors), colors.new_ones(len(colors), 1)], 1)
                scenes.append(Scene(vertices, faces, paint, camera))
        return scenes

    def read(self, files: Sequence[Path]) -> Dataset[Batch]:
        """Return one sample for each coloured mesh and each of its cameras.

        The cameras of a mesh are read from the file cameras.json in the same folder. Without such a file there is one
        camera, which sees the whole mesh from the front.
        """
        if not files:
            raise DataError("The list of files is empty; expected one or more meshes with vertex colours.")
        inputs = [points for file in files for points in self._points_from_cameras(Path(file))]
        return Fields(input=clouds.pad(inputs), index=torch.arange(len(inputs)))

    def _points_from_cameras(self, file: Path) -> list[Float[Tensor, "points 6"]]:
        mesh = read(file)
        colors = torch.from_numpy(scan_layout.vertex_colors(mesh))
        vertices = torch.from_numpy(mesh.vertices).float()
        beside = file.with_name("cameras.json")
        cameras = (
            list(scan_layout.read_cameras(beside).values())
            if beside.exists()
            else [in_front(vertices, *self.size)]
        )
        return [_input(vertices, colors, camera) for camera in cameras]

    def state_dict(self) -> Mapping[str, Any]:
        return {"height": self.size[0], "width": self.size[1]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        if set(state) != {"height", "width"}:
            raise DataError(
                f"The stored state of human_scans must hold height and width, but it holds "
                f"{', '.join(state) or 'nothing'}. Use the data on which the model was trained."
            )
        height, width = state["height"], state["width"]
        whole = type(height) is int and type(width) is int
        if not whole or min(height, width) < 1 or height * width > MOST_INPUT:
            raise DataError(
                f"The stored image size of human_scans is {shorten(height)} by {shorten(width)}; expected two whole "
                f"numbers whose product is at most {MOST_INPUT:,} pixels. Load another checkpoint, or train again."
            )
        self.size = (height, width)

    def augment(self, batch: Batch) -> Batch:
        """Return the batch with random mirroring and permuted colours, drawn for each sample."""
        count = len(batch["input"])
        mirrored = torch.rand(count) < (0.5 if self.variation.mirrored else 0.0)
        orders = torch.rand(count, 3).argsort(1)
        orders[torch.rand(count) >= self.variation.recoloured] = torch.arange(3)
        augmented = dict(batch)
        for name in ("target", "color", "mask"):
            if name in batch:
                augmented[name] = _mirror(batch[name], mirrored)
                if batch[name].shape[-1:] == (3,) and batch[name].dim() == 4:  # silhouettes have no colours
                    augmented[name] = _permute_colors(augmented[name], orders)
        points = batch["input"].clone()
        points[mirrored.to(points.device), :, 0] *= -1  # the canonical camera's centre is the image's
        points[..., 3:6] = _permute_colors(points[..., 3:6], orders)
        return augmented | {"input": points}

    def fingerprint(self) -> Mapping[str, str]:
        return {
            "root": "generated" if self.root is None else self.root,
            "version": f"human_scans {VERSION}",
            "topology": self.topology,
            **({} if self.shows == "photograph" else {"shows": self.shows}),
            "size": "×".join(map(str, self.size)),
            **{name: str(len(split)) for name, split in self._splits._asdict().items()},
            "sha256": self._digest,
        }

    def preview(self, inputs: Tensor) -> np.ndarray:
        """Return an image on white in which each point that the canonical camera sees colours one pixel.

        If several points fall on a pixel, the nearest one is shown.
        """
        height, width = self.size
        points = inputs.detach().cpu().float()
        points = points[points.isfinite().all(1)]
        place, depth = canonical_camera(height, width).project(points[:, :3])
        image = torch.ones(height * width, 3)
        order = (-depth).argsort(stable=True)  # the nearest last
        column, row = place[order].round().T
        visible = (depth[order] > 0) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = (row[visible] * width + column[visible]).long().numpy()
        # if several points share a pixel, NumPy keeps the last
        image.numpy()[pixel] = points[order][visible][:, 3:].numpy()
        return (image.clamp(0, 1) * 255).round().byte().view(height, width, 3).numpy()


class Photographs(Dataset[Batch]):
    """Photographs of one split, read when they are fetched, in the order of subjects and of each subject's views.

    Args:
        subjects: subjects of the split.
        shows: kind of the target, "photograph" or "subject" (the segmentation).
    """

    def __init__(self, subjects: Sequence[Subject], shows: Shows) -> None:
        self.shows = shows
        self.subjects = list(subjects)
        self.of = [(number, view) for number, subject in enumerate(subjects) for view in subject.views]

    def __len__(self) -> int:
        return len(self.of)

    def __getitem__(self, index: int) -> Batch:
        number, view = self.of[index]
        registration = self.subjects[number].mesh
        light, cover = photograph(view)
        mask = cover >= 0.5
        return {
            "input": _input(registration.vertices, registration.colors, view.camera),
            "target": srgb_from_linear(light) if self.shows == "photograph" else mask.float()[..., None],
            "color": light,
            "mask": mask,
            "subject": torch.tensor(number),
            "group": torch.tensor(0),
            "index": torch.tensor(range(len(self))[index]),
        }


def photograph(view: View) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
    """Return a photograph on white in linear RGB, and the share of each pixel that the subject covers."""
    pixels, mask = scan_layout.read_photograph(view)
    cover = torch.from_numpy(mask).float() / 255
    return linear_from_bytes(torch.from_numpy(pixels)) * cover[..., None] + (1 - cover[..., None]), cover


def in_front(vertices: Float[Tensor, "vertices 3"], height: int, width: int) -> Camera:
    """Return an upright camera that sees the whole mesh from the front, with the lens of the canonical camera.

    The front of the mesh faces along z, and y points up. The image has `height` × `width` pixels.
    """
    low, high = vertices.min(0).values, vertices.max(0).values
    middle, extent = (low + high) / 2, high - low
    # the front of the mesh fills nine tenths of the image at most; the focal length is `height` pixels
    away = float(torch.stack([extent[1], extent[0] * height / width]).max()) / 0.9 + float(extent[2]) / 2
    rotation = torch.tensor([1.0, -1.0, -1.0]).diag()
    ahead = torch.tensor([0.0, 0.0, max(away, 1e-3)])
    standard = canonical_camera(height, width)
    return Camera(rotation, ahead - rotation @ middle, standard.focal, standard.principal, height, width)


def _mirror(images: Tensor, which: Tensor) -> Tensor:
    """Return images (image, height, width, ...); left and right are exchanged in those where `which` is true."""
    chosen = which.to(images.device).view(-1, *[1] * (images.dim() - 1))
    return torch.where(chosen, images.flip(2), images)


def _permute_colors(colors: Float[Tensor, "batch ... 3"], orders: Tensor) -> Tensor:
    """Return the colours with permuted channels; `orders`, (batch, 3), holds the permutation of each sample."""
    places = orders.to(colors.device).view(-1, *[1] * (colors.dim() - 2), 3)
    return colors.gather(-1, places.expand(colors.shape))


def _input(vertices: Tensor, colors: Tensor, camera: Camera) -> Float[Tensor, "points 6"]:
    return torch.cat([camera.to_canonical(vertices), colors.float() / 255], 1)


def _common_size(root: Path, subjects: Sequence[Subject]) -> tuple[tuple[int, int], int]:
    """Return the size of all images, and the number of vertices of all meshes."""
    first = subjects[0]
    size = (first.views[0].camera.height, first.views[0].camera.width)
    points = len(first.mesh.vertices)
    for subject in subjects:
        folder = root / "subjects" / subject.name
        if (other := len(subject.mesh.vertices)) != points:
            raise DataError(
                f"{folder}: the registration has {other} vertices, but that of {first.name} has {points}; expected "
                "the same topology for all subjects. Copy the registration again from its source."
            )
        for view in subject.views:
            if (other := (view.camera.height, view.camera.width)) != size:
                raise DataError(
                    f"{folder}: view {view.name} has {other[0]} × {other[1]} pixels, but the first image of the data "
                    f"set has {size[0]} × {size[1]} (height × width); expected one size. Scale the images and their "
                    "camera matrices K."
                )
    return size, points


def _digest(subjects: Mapping[str, Sequence[Subject]]) -> str:
    """Return a hash of names, meshes and cameras, and of the checksums in the files of photographs and masks."""
    digest = hashlib.sha256()
    for split, some in subjects.items():
        for subject in some:
            digest.update(f"{split} {subject.name}\n".encode())
            registration = subject.mesh
            for part in (registration.vertices, registration.colors, registration.faces):
                digest.update(part.numpy().tobytes())
            for view in subject.views:
                digest.update(f"{view.name} {view.camera}\n".encode())
                digest.update(scan_layout.tail(view.image) + scan_layout.tail(view.mask))
    return digest.hexdigest()
