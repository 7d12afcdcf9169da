"""`python -m plugins.data.registration.correspond <run> [<FAUST>]` writes results for the challenges of FAUST.

Without a folder, synthetic people are generated in FAUST's layout; their true correspondences are known.
"""

import argparse
import sys
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import NamedTuple
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np
import torch
from jaxtyping import Float, Int

from framework.configuration.loading import load_with_description
from framework.configuration.paths import add_option, parse_paths, require_paths
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.distributions.protocol import median
from framework.errors import ConfigError
from framework.geometry.clouds import denormalise_clouds
from framework.geometry.meshes import read
from framework.geometry.nearest import nearest
from framework.storage.commands import run_command
from framework.storage.generated import read_mark
from plugins.data.registration.faust import CHALLENGES, Challenge, pairs, test_registration, test_scan
from plugins.data.registration.faust_generator import people_root

RegisterScan = Callable[[Path], Float[np.ndarray, "vertex 3"]]
"""Function from a scan's file to the vertices registered to it, metres."""


class ChallengeResult(NamedTuple):
    """Result of one challenge.

    Attributes:
        file: a zip with one text file for each pair, which holds for each vertex of the first scan the position x, y, z
            on the second scan, metres.
        pairs: number of pairs.
        error_cm: mean error over the vertices, centimetres, of each pair whose true registrations exist.
    """

    file: Path
    pairs: int
    error_cm: list[float]


def main(arguments: list[str]) -> None:
    """Write `<out>/intra.zip` and `inter.zip`; print errors if the true correspondences are known.

    Raises:
        UserError: the checkpoint is of another data set, or a file cannot be read.
    """
    parser = argparse.ArgumentParser(
        prog="python -m plugins.data.registration.correspond", description=__doc__
    )
    parser.add_argument("checkpoint", help="run folder, checkpoint file or MLflow run id")
    parser.add_argument(
        "root", nargs="?", help="folder that holds the folder `test` of FAUST; default: generated people"
    )
    parser.add_argument("--out", type=Path, default=Path("outputs/faust"), help="default: outputs/faust")
    add_option(parser)
    options = parser.parse_intermixed_args(arguments)
    registered, generated = model(options.checkpoint, parse_paths(options.path))
    folder = generated() if options.root is None else Path(options.root).expanduser()
    marked = "" if read_mark(folder) is None else " (synthetic)"
    for challenge in CHALLENGES:
        result = write_correspondences(registered, folder, challenge, options.out)
        error = "unknown, because FAUST does not publish the registrations of its test scans"
        if result.error_cm:
            error = (
                f"{np.mean(result.error_cm):.2f} cm, of the worst pair {max(result.error_cm):.2f} cm{marked}"
            )
        sys.stdout.write(f"{challenge}: {result.pairs} pairs in {result.file}; error {error}\n")


def model(checkpoint: str, paths: Mapping[str, str] | None = None) -> tuple[RegisterScan, Callable[[], Path]]:
    """Return a trained model's registration function, and a function that returns a folder of generated people.

    The registration function reads the file of a scan and returns the vertices of the registered mesh. The second
    function generates people of the model's body in FAUST's layout on its first call.

    Args:
        checkpoint: run folder, checkpoint file or MLflow run id.
        paths: files and folders by their keys in the model's configuration. A path that is stored in the checkpoint is
            used only if it is repeated here.

    Raises:
        ConfigError: the checkpoint is of another data set.
    """
    predictor, description = load_with_description(checkpoint, paths=paths)
    part = description.config["data"]
    if part["name"] not in ("registration", "faust"):
        raise ConfigError(
            f"{checkpoint} was trained on data {part['name']!r}; expected a model trained on `registration` or "
            "`faust`, whose target is a mesh. Choose another checkpoint."
        )
    data: Data = build("data", resolve("data", part))

    @torch.no_grad()
    def registered(scan: Path) -> np.ndarray:
        batch = data.user_batch(scan)
        local = median(predictor(batch["input"]), 1).unflatten(1, (-1, 3))
        return denormalise_clouds(local, batch["centre"], batch["scale"])[0].float().numpy()

    def generated() -> Path:
        require_paths(description.dropped, ("data",), description.path)
        return people_root(part.get("body"))

    return registered, generated


def write_correspondences(
    registered: RegisterScan, root: Path, challenge: Challenge, out: Path
) -> ChallengeResult:
    """Compute the correspondences of every pair through registered meshes, and write them to `<out>/<challenge>.zip`.

    For a vertex of the first scan, the nearest vertex of the mesh that is registered to the first scan is found. The
    vertex with the same number in the mesh that is registered to the second scan gives the position on the second scan
    (thesis §6.5.2). `registered` registers a mesh to the file of a scan (`model`), and is called once for each scan.
    `root` is the folder of FAUST.

    Raises:
        DataError: the challenge has no pairs, or a scan cannot be read.
    """
    mesh_of = cache(registered)
    scan_pairs = pairs(root, challenge)
    out.mkdir(parents=True, exist_ok=True)
    file, errors = out / f"{challenge}.zip", []
    with ZipFile(file, "w", ZIP_DEFLATED) as archive:
        for pair in scan_pairs:
            first, second = (mesh_of(test_scan(root, number)) for number in pair)
            corresponding = second[_nearest(first, read(test_scan(root, pair.first)).vertices)]
            lines = [f"{x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in corresponding.tolist()]
            archive.writestr(f"{pair}.txt", "".join(lines))
            truths = [test_registration(root, number) for number in pair]
            if all(truth.is_file() for truth in truths):
                first_true, second_true = (read(truth).vertices for truth in truths)
                gap = np.linalg.norm(second[_nearest(first, first_true)] - second_true, axis=1)
                errors.append(100 * float(gap.mean()))
    return ChallengeResult(file, len(scan_pairs), errors)


def _nearest(vertices: np.ndarray, points: np.ndarray) -> Int[np.ndarray, "points"]:
    """Return the number of the vertex nearest to each point."""
    reference, queries = (torch.from_numpy(part).float()[None] for part in (vertices, points))
    return nearest(reference, queries).index[0].numpy()


if __name__ == "__main__":
    run_command(main)
