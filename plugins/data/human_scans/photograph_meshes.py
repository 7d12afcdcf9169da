"""`python -m plugins.data.human_scans.photograph_meshes <meshes> <root>` makes data of `human_scans` from meshes.

<meshes> holds the folders train, validation and test. For each person they hold two meshes with vertex colours:
`<name>_scan.ply` (.obj, ...), which the photographs show, and `<name>_registration.ply`, which is the input of a
renderer. All registrations have one topology. Meshes are in metres, with y up, and face z.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch

from framework.configuration.schema import build, resolve
from framework.data import Splits
from framework.datasets import scan_layout
from framework.datasets.scan_layout import RegisteredMesh
from framework.errors import DataError
from framework.geometry import meshes
from framework.geometry.meshes import READERS, stream
from framework.geometry.srgb import linear_from_bytes
from framework.renderer import Renderer, Scene
from framework.storage.commands import run_command
from framework.storage.generated import draw_all, ensure_generated
from plugins.data.human_scans.photographs import place_cameras, take_photographs

Pair = tuple[Path, Path]
"""Paths of a scan and of its registration."""


def main(arguments: list[str]) -> None:
    """Write the data set to the folder <root>, completely or not at all.

    Raises:
        UserError: a mesh is missing, cannot be read or has no colours; the root exists already.
    """
    parser = argparse.ArgumentParser(
        prog="python -m plugins.data.human_scans.photograph_meshes", description=__doc__
    )
    parser.add_argument("meshes", type=Path, help="folder with train, validation and test")
    parser.add_argument("root", type=Path, help="new folder for the data set")
    parser.add_argument("--views", type=int, default=12, help="photographs of each person; default: 12")
    parser.add_argument(
        "--size", type=int, nargs=2, default=(256, 192), help="height and width; default: 256 192"
    )
    parser.add_argument(
        "--topology", default="7k", help="name of the topology, the value of data.topology; default: 7k"
    )
    parser.add_argument(
        "--renderer", default="rasterizer", help="renderer of the photographs; default: rasterizer"
    )
    options = parser.parse_args(arguments)
    renderer: Renderer = build("renderer", resolve("renderer", {"name": options.renderer}))
    if options.root.exists():
        raise DataError(
            f"{options.root} exists already; expected a new folder. Choose another name, or remove the folder."
        )
    people = pairs(options.meshes)
    count = sum(map(len, people.values()))
    mark = {
        "photographed": str(options.meshes),
        "people": count,
        "views": options.views,
        "size": list(options.size),
    }

    def write(root: Path) -> None:
        scan_layout.write_splits(root, {split: list(some) for split, some in people.items()})
        everyone = [(name, pair) for some in people.values() for name, pair in some.items()]

        def write_numbered(number: int) -> None:
            name, pair = everyone[number]
            write_person(
                root / "subjects" / name, pair, options.topology, renderer, options.views, tuple(options.size)
            )

        draw_all(len(everyone), write_numbered, "people")

    ensure_generated(options.root, mark, write)
    sys.stdout.write(f"{options.root}: {count} people\n")


def pairs(folder: Path) -> Mapping[str, Mapping[str, Pair]]:
    """Return the paths of scan and registration of each person, by split and name.

    Raises:
        DataError: a split has no scans, a scan no registration, or two people have one name.
    """
    pairs_by_split: dict[str, dict[str, Pair]] = {}
    for split in Splits._fields:
        files = {
            file.stem: file for file in sorted((folder / split).glob("*")) if file.suffix.lower() in READERS
        }
        scans = [stem for stem in files if stem.endswith("_scan")]
        if not scans:
            raise DataError(
                f"{folder / split}: the folder has no scan; expected files such as ann_scan.ply and "
                "ann_registration.ply."
            )
        pairs_by_split[split] = {}
        for stem in scans:
            name = stem.removesuffix("_scan")
            if f"{name}_registration" not in files:
                raise DataError(
                    f"{files[stem]}: the registration of this scan is missing; expected {name}_registration.ply beside "
                    "it."
                )
            if any(name in earlier for earlier in pairs_by_split.values()):
                raise DataError(
                    f"{files[stem]}: the name {name} occurs twice; expected a different name for each person."
                )
            pairs_by_split[split][name] = files[stem], files[f"{name}_registration"]
    return pairs_by_split


def write_person(
    folder: Path, pair: Pair, topology: str, renderer: Renderer, views: int, size: tuple[int, int]
) -> None:
    """Write the photographs of a person's scan and the registration to a folder.

    The camera positions depend only on the name of the folder, which is the name of the person.

    Args:
        folder: folder of the person.
        pair: files of the scan and of the registration.
        topology: name of the registration's topology.
        renderer: renderer that draws the photographs.
        views: number of photographs.
        size: height and width of a photograph, pixels.
    """
    scan, registration = (meshes.read(file) for file in pair)
    scan_layout.write_registration(
        folder / f"registration_{topology}.ply",
        RegisteredMesh(
            torch.from_numpy(registration.vertices).float(),
            torch.from_numpy(scan_layout.vertex_colors(registration)),
            torch.from_numpy(registration.faces),
        ),
    )
    cameras = place_cameras(scan.vertices, views, size, stream(0, folder.name))
    colors = linear_from_bytes(torch.from_numpy(np.ascontiguousarray(scan_layout.vertex_colors(scan))))
    faces = torch.from_numpy(scan.faces)
    scene = Scene(torch.from_numpy(scan.vertices).float(), faces, colors, cameras[0])
    scan_layout.write_views(folder, cameras, take_photographs(renderer, scene, cameras))


if __name__ == "__main__":
    run_command(main)
