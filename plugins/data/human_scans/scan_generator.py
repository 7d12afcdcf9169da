"""Generator of dressed people and of their simulated scans, in the layout of `human_scans`."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.random import Generator
from PIL import Image
from pydantic import Field
from torch import Tensor

from framework.bodies import poses
from framework.bodies.people import load_body, sample_adults
from framework.bodies.topologies import Name, Topology, topology
from framework.configuration.paths import FilePath
from framework.datasets import scan_layout
from framework.datasets.scan_layout import RegisteredMesh
from framework.errors import ConfigError
from framework.geometry.srgb import linear_from_bytes
from framework.renderer import Renderer, Scene
from framework.storage import cache
from framework.storage.generated import draw_all, ensure_generated
from plugins.data.human_scans import skins
from plugins.data.human_scans.dressed import Wardrobe
from plugins.data.human_scans.photographs import place_cameras, take_photographs, texture

VERSION = 1
"""Version of the random draws; increase it if the draws change, so that people are generated anew."""
SPLITS = ("train", "validation", "test")
CALM = 0.4
"""Spread of the movements of people who stand still in an A-pose, as a share of the usual spread."""
RAISED = 38.0
"""Angle between the arms of an A-pose and hanging arms, degrees."""


@dataclass(frozen=True, kw_only=True)
class Drawing:
    """Settings of generated people and of their photographs.

    Attributes:
        views: number of photographs of each person.
        height, width: size of a photograph, pixels.
        topologies: names of the topologies in which a mesh is registered to each scan.
        posed: share of the test subjects that have a random pose instead of an A-pose.
        texture_side: texels along a side of texture.png; 0 for no texture.
        skins: folder of images of skin in the default body's texture layout, each of which is used in one split only;
            None for skin that is painted procedurally.
        body: file of a body model of the SMPL family (.npz, .pkl); None: the default body.
    """

    views: Annotated[int, Field(ge=1, le=1_000)] = 12
    height: Annotated[int, Field(ge=8, le=4096)] = 256
    width: Annotated[int, Field(ge=8, le=4096)] = 192
    topologies: Annotated[tuple[Name, ...], Field(min_length=1)] = ("7k", "27k")
    posed: Annotated[float, Field(ge=0, le=1)] = 0.0
    texture_side: Annotated[int, Field(ge=0, le=8192)] = 512
    skins: FilePath | None = None
    body: FilePath | None = None


def scans_root(renderer: Renderer, counts: Mapping[str, int], drawing: Drawing, seed: int) -> Path:
    """Return the folder of generated people in the cache, after generating them if it does not exist.

    Args:
        renderer: renderer that draws the photographs.
        counts: number of subjects of each split, by its name.
        drawing: settings of the people and of the photographs.
        seed: seed of all random draws.

    Raises:
        DataError: the body or the skins are not available or cannot be read.
        ConfigError: there are fewer skins than splits, or skins for a body without texture coordinates.
    """
    crowd = Crowd(renderer, counts, drawing, seed)
    return ensure_generated(crowd.root, crowd.mark, crowd.write)


class Person(NamedTuple):
    """A generated person without clothes.

    Attributes:
        shape: shape coefficients.
        pose: rotations of the joints.
        skin: image of the skin; None if the skin is to be painted.
        random: generator of further random draws for this person.
    """

    shape: Float[Tensor, "1 shape"]
    pose: Float[Tensor, "1 joint 3"]
    skin: UInt8[np.ndarray, "height width 3"] | None
    random: Generator


class Crowd:
    """All generated people of a data set; a person depends only on the settings, the seed, the split and a number.

    The renderer draws the photographs. `counts` is the number of subjects of each split, by its name, `drawing` holds
    the settings of people and photographs, and `seed` is the seed of all random draws.
    """

    def __init__(self, renderer: Renderer, counts: Mapping[str, int], drawing: Drawing, seed: int) -> None:
        self.renderer, self.counts, self.drawing, self.seed = renderer, dict(counts), drawing, seed
        self.body, self.traits = load_body(drawing.body)
        self.skins = _split_skins(drawing.skins, self.body.uv is not None)
        # body and skins are identified by their content, not by their paths
        settings = {key: value for key, value in asdict(drawing).items() if key not in ("skins", "body")}
        self.mark = {
            "human_scans": VERSION,
            "data_seed": seed,
            **self.counts,
            **settings,
            "topologies": list(drawing.topologies),
            "body": _hash(self.body.template.tobytes(), self.body.faces.tobytes()),
            "skins": [[file.name, _hash(skins.content(file))] for some in self.skins for file in some],
            "renderer": f"{type(renderer).__module__}.{type(renderer).__qualname__}",
        }
        self.root = cache.folder("human_scans") / _hash(repr(sorted(self.mark.items())).encode())

    @cached_property
    def wardrobe(self) -> Wardrobe:
        """Return the `Wardrobe` that dresses all people; it is built once."""
        return Wardrobe(self.body)

    @cached_property
    def meshes(self) -> dict[Name, Topology]:
        """Return the topologies to write, by name; they are computed once."""
        return {name: topology(self.body, self.wardrobe.sheet, name) for name in self.drawing.topologies}

    def write(self, root: Path) -> None:
        """Write all people to a folder in the layout of framework.datasets.scan_layout."""
        everyone = [(split, number) for split in SPLITS for number in range(self.counts[split])]
        scan_layout.write_splits(
            root, {split: [_name(split, number) for number in range(self.counts[split])] for split in SPLITS}
        )
        if self.wardrobe.uv is not None:
            for name, mesh in self.meshes.items():
                uv = self.wardrobe.uv[mesh.uv_rows].astype(np.float32)
                np.savez(root / f"topology_{name}.npz", faces=mesh.faces, uv=uv, uv_faces=mesh.uv_faces)
        (root / "README.txt").write_text(scan_layout.__doc__ or "", encoding="utf-8")
        draw_all(len(everyone), lambda index: self._write_person(root, *everyone[index]), "dressed people")

    def _write_person(self, root: Path, split: str, number: int) -> None:
        folder = root / "subjects" / _name(split, number)
        shape, pose, skin, random = self.person(split, number)
        scan, registered = self.wardrobe.dress(self.posed(shape, pose), skin, random)
        views = place_cameras(
            scan.vertices, self.drawing.views, (self.drawing.height, self.drawing.width), random
        )
        for name, mesh in self.meshes.items():
            scan_layout.write_registration(
                folder / f"registration_{name}.ply",
                RegisteredMesh(
                    torch.from_numpy(registered.vertices[mesh.rows]).float(),
                    torch.from_numpy(registered.colors[mesh.rows]),
                    torch.from_numpy(mesh.faces),
                ),
            )
        scene = Scene(
            torch.from_numpy(scan.vertices).float(),
            torch.from_numpy(scan.faces),
            torch.from_numpy(scan.colors).float(),
            views[0],
        )
        scan_layout.write_views(folder, views, take_photographs(self.renderer, scene, views))
        if self.drawing.texture_side and self.wardrobe.uv is not None:
            faces = self.wardrobe.sheet.corners[-1].uv_faces
            colors = linear_from_bytes(torch.from_numpy(registered.colors[self.wardrobe.vertex_of_place]))
            pixels = texture(self.renderer, self.wardrobe.uv, faces, colors, self.drawing.texture_side)
            Image.fromarray(pixels).save(folder / "texture.png")

    def person(self, split: str, number: int) -> Person:
        """Return the shape, the pose and the skin of person `number` of a split, without clothes."""
        random = np.random.default_rng([self.seed, SPLITS.index(split), number])
        skin = None
        if some := self.skins[SPLITS.index(split)]:
            skin = skins.read(some[int(random.integers(len(some)))])
        if self.traits is None:
            shape = torch.from_numpy(random.normal(0, 1, (1, min(10, self.body.shapes.shape[2]))))
        else:
            shape = self.traits.coefficients(torch.from_numpy(sample_adults(self.traits.labels, 1, random)))
        anyhow = split == "test" and random.random() < self.drawing.posed
        movements = poses.draw(1, random) if anyhow else a_pose(random)
        pose = poses.rotations(self.body, poses.skeleton(self.body), movements)
        return Person(shape, torch.from_numpy(pose), skin, random)

    @torch.no_grad()
    def posed(
        self, shape: Float[Tensor, "1 shape"], pose: Float[Tensor, "1 joint 3"]
    ) -> Float[np.ndarray, "vertices 3"]:
        """Return the vertices of the bare body in a pose, metres."""
        kind = self.wardrobe.model.template.dtype
        return self.wardrobe.model(shape.to(kind), pose.to(kind))[0].numpy()


def a_pose(random: Generator) -> Float[np.ndarray, "1 movement"]:
    """Return movements, degrees, of a person who stands nearly still in an A-pose, with the arms away from the body."""
    ranges = [*poses.CENTRAL.values(), *2 * (*poses.SIDED.values(),)]
    usual, spread, least, most = np.array(ranges, float).T
    usual = np.where(np.char.endswith(np.array(poses.MOVEMENTS), "raise"), RAISED, usual)
    return (usual + CALM * spread * random.normal(size=len(usual))).clip(least, most)[None]


def _name(split: str, number: int) -> str:
    return f"{split}_{number:04}"


def _split_skins(folder: str | None, has_places: bool) -> list[list[Path]]:
    """Return the skins of each split: a quarter for test and an eighth for validation, at least one each.

    All others are for training.
    """
    if folder is None:
        return [[], [], []]
    if not has_places:
        raise ConfigError(
            "data.skins needs a body with texture coordinates, such as the default body. Leave out data.skins or "
            "data.body."
        )
    files = skins.files(Path(folder).expanduser())
    if len(files) < 3:
        raise ConfigError(
            f"data.skins = {folder} holds {len(files)} skins; expected three at least, one for each split. Add images, "
            "or set data.skins to null."
        )
    order = [files[place] for place in np.random.default_rng(0).permutation(len(files))]
    test, validation = max(len(files) // 4, 1), max(len(files) // 8, 1)
    return [order[test + validation :], order[test : test + validation], order[:test]]


def _hash(*parts: bytes) -> str:
    digest = hashlib.sha256()
    for part in parts:
        digest.update(part)
    return digest.hexdigest()[:16]
