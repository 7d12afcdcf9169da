"""`python -m plugins.data.registration <checkpoint> <scan> ...` registers a mesh to each scan.

For each scan, the command writes a PLY file of the registered mesh and the scan's points, and a figure.
"""

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path

import torch

from framework.bodies.people import load_body
from framework.configuration.loading import load_with_description, training_data
from framework.configuration.paths import add_option, parse_paths
from framework.distributions.protocol import median
from framework.figures.style import save_figure
from framework.geometry.clouds import denormalise_clouds, sizes
from framework.storage.commands import run_command
from plugins.data.registration.data import Registration
from plugins.data.registration.result import figure, write_ply


def main(arguments: list[str]) -> None:
    """Write `<folder>/<scan>_registered.ply` and `<folder>/<scan>_registered.png` for each scan.

    The meshes are in metres and in the coordinates of the scan.

    Raises:
        UserError: the checkpoint is of another data set, or a file cannot be read.
    """
    parser = argparse.ArgumentParser(prog="python -m plugins.data.registration", description=__doc__)
    parser.add_argument("checkpoint", help="run folder, checkpoint file or MLflow run id")
    parser.add_argument("scans", nargs="+", type=Path, help="meshes or clouds, metres, y up, facing z")
    parser.add_argument(
        "--folder", type=Path, default=Path("outputs"), help="folder for the results; default: outputs"
    )
    add_option(parser)
    options = parser.parse_intermixed_args(arguments)
    options.folder.mkdir(parents=True, exist_ok=True)
    for file in register(options.checkpoint, options.scans, options.folder, parse_paths(options.path)):
        sys.stdout.write(f"{file}\n")


@torch.no_grad()
def register(
    checkpoint: str, scans: list[Path], folder: Path, paths: Mapping[str, str] | None = None
) -> list[Path]:
    """Register a mesh to each scan and return the paths of the written files, two for each scan.

    `paths` holds files and folders by their keys in the model's configuration. A path that is stored in the checkpoint
    is used only if it is repeated there.
    """
    predictor, description = load_with_description(checkpoint, paths=paths)
    data: Registration = training_data(description, "registration")
    faces = load_body(data.body)[0].faces
    written = []
    for scan in scans:
        batch = data.user_batch(scan)
        local = median(predictor(batch["input"]), 1).unflatten(1, (-1, 3))
        place = batch["centre"], batch["scale"]
        vertices = denormalise_clouds(local, *place)[0].numpy()
        cloud = denormalise_clouds(batch["input"], *place)[0, : int(sizes(batch["input"]))].numpy()
        stem = folder / f"{scan.stem}_registered"
        write_ply(stem.with_suffix(".ply"), vertices, faces, cloud)
        distance_figure = figure(vertices, faces, cloud, f"Mesh registered to {scan.name}")
        written += [stem.with_suffix(".ply"), save_figure(distance_figure, stem, True)]
    return written


if __name__ == "__main__":
    run_command(main)
