"""mode=encode: compute the features of very many files in parts, which several jobs can share and a job can resume."""

import hashlib
import io
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from framework.configuration.config import Config, Options
from framework.configuration.schema import build, resolve
from framework.configuration.settings import Settings
from framework.data import Data
from framework.encoder import Encoder
from framework.errors import ConfigError, DataError
from framework.runs.run import open_run
from framework.runs.session import record_citations, set_up_process
from framework.runs.user_files import UNREADABLE, select_files
from framework.storage.enclosed import require_enclosed
from framework.storage.files import write_whole
from framework.storage.names import spell_name
from framework.storage.plain_values import read_json
from framework.storage.progress import Work
from framework.training.batches import Batches

DESCRIPTION, NAMES = "encoding.json", "files.txt"
"""Files beside the parts: the settings of the computation, and the names of the encoded files, one per line."""


class EncodeOptions(Options):
    """Options of mode=encode: the files to encode, and the folder for the features."""

    files: str
    into: str
    part: Annotated[int, Field(gt=0)] = 1000
    share: Annotated[str, Field(pattern=r"^[1-9]\d*/[1-9]\d*$")] = "1/1"


@dataclass(frozen=True)
class Collection:
    """Files to encode, divided into parts, and the folder for the features.

    Attributes:
        root: Folder to which the names are relative.
        names: Names of the files, in order.
        part: Number of files in a part.
        into: Folder of the parts.
    """

    root: Path
    names: Sequence[str]
    part: int
    into: Path

    @property
    def parts(self) -> int:
        """Return the number of parts."""
        return -(-len(self.names) // self.part)

    def files(self, number: int) -> list[Path]:
        """Return the files of the part with this number, counted from 0."""
        return [self.root / name for name in self.names[number * self.part : (number + 1) * self.part]]

    def path(self, number: int) -> Path:
        """Return the file for the features of a part."""
        return self.into / f"part-{number:06}.npy"

    def missing(self) -> list[int]:
        """Return the numbers of the parts that are not written yet."""
        return [number for number in range(self.parts) if not self.path(number).is_file()]


def run(config: Config) -> None:
    """Write this job's share of the parts; parts that exist already are left unchanged."""
    options = config.options(EncodeOptions)
    console = set_up_process(config.settings)
    chosen = config.values
    parts = {
        "data": resolve("data", chosen.get("data") or {}),
        "encoder": [
            resolve("encoder", part, f"encoder.{key}") for key, part in (chosen.get("encoder") or {}).items()
        ],
    }
    if not parts["encoder"]:
        raise ConfigError("mode=encode wants an encoder. Name one; mode=plugins lists them.")
    collection = collected(Path(options.files).expanduser(), Path(options.into).expanduser(), options.part)
    require_enclosed(collection.into, ConfigError)
    files = [collection.root / name for name in collection.names]
    kept, bad = select_files(build("data", parts["data"]), files, parts["data"], console)
    collection = replace(collection, names=[file.relative_to(collection.root).as_posix() for file in kept])
    mine = share(collection.parts, options.share)
    with open_run(config) as run:
        record_citations(run, parts)
        describe(collection, parts)
        try:
            written = encode(collection, parts, mine, config.settings)
        except BaseException:
            if (
                len(collection.missing()) == collection.parts
            ):  # without any part, the description is removed, as another attempt may use other settings
                for name in (DESCRIPTION, NAMES):
                    (collection.into / name).unlink(missing_ok=True)
            raise
        describe(collection, parts)  # written again if another job failed meanwhile and removed it
        if bad:
            left_out = "".join(f"{spell_name(file.relative_to(collection.root))}\n" for file in bad)
            write_whole(collection.into / UNREADABLE, left_out.encode())
        left = len(collection.missing())
        console.print(
            f"{written} parts written, {len(mine) - written} of this job's {len(mine)} were there; "
            f"{left} of all {collection.parts} are missing: {collection.into}",
            soft_wrap=True,
        )


def share(parts: int, which: str) -> range:
    """Return the parts of a job: for job "2/4", every fourth part from the second on.

    Raises:
        ConfigError: The number of the job exceeds the number of jobs.
    """
    number, jobs = map(int, which.split("/"))
    if number > jobs:
        raise ConfigError(
            f"mode.share={which}: there is no job {number} of {jobs}; wanted 1/{jobs} to {jobs}/{jobs}."
        )
    return range(number - 1, parts, jobs)


def collected(root: Path, into: Path, part: int) -> Collection:
    """Return all files of a folder and its subfolders except hidden ones, sorted by name.

    Raises:
        DataError: There are no files.
        ConfigError: The folder for the features lies inside the folder of the files.
    """
    if into.resolve().is_relative_to(root.resolve()):
        raise ConfigError(
            f"mode.into={into} lies in mode.files={root}, and would be read itself. Give another folder."
        )
    found = (path.relative_to(root) for path in root.rglob("*") if path.is_file())
    names = sorted(
        path.as_posix() for path in found if not any(piece.startswith(".") for piece in path.parts)
    )
    if not names:
        raise DataError(f"mode.files={root} is no folder that holds files. Give the folder to encode.")
    return Collection(root, names, part, into)


def describe(collection: Collection, config: Mapping[str, Any]) -> None:
    """Write the description of the parts beside them, or check that an existing one is the same.

    Raises:
        ConfigError: The folder holds parts of other files or settings.
    """
    text = "".join(f"{spell_name(name)}\n" for name in collection.names).encode()
    said = {
        "version": 1,
        **config,
        "part": collection.part,
        "files": len(collection.names),
        "names": hashlib.sha256(text).hexdigest(),
    }
    collection.into.mkdir(parents=True, exist_ok=True)
    path = collection.into / DESCRIPTION
    if path.is_file():
        there = read_json(path, "the description of encoded files", "Delete it, or give another mode.into.")
        for key, value in said.items():
            if there.get(key) != value:
                raise ConfigError(
                    f"{path} says {key} = {there.get(key)}, this job {value}: its parts are of something else. "
                    "Give the same files and settings, or another mode.into."
                )
        return
    write_whole(collection.into / NAMES, text)
    write_whole(path, json.dumps(said, indent=1).encode())


@torch.no_grad()
def encode(collection: Collection, config: Mapping[str, Any], mine: Sequence[int], settings: Settings) -> int:
    """Write the missing parts, and return their number; a part is whole or absent.

    Args:
        collection: Files to encode.
        config: Resolved configs of the data set and the encoders.
        mine: Numbers of the parts of this job.
        settings: Settings of the command.

    Raises:
        ConfigError: An encoder learns, or there is no encoder.
        DataError: A file cannot be read, or holds several samples; the message names it. Earlier parts are kept.
    """
    if not config["encoder"]:
        raise ConfigError("mode=encode wants an encoder. Name one; mode=plugins lists them.")
    data: Data = build("data", config["data"])
    encoders: list[Encoder] = []
    written = 0
    with Work("encoding", sum(len(collection.files(number)) for number in mine), "files") as work:
        for number in mine:
            files = collection.files(number)
            if collection.path(number).is_file():
                work.advance(len(files))
                continue
            dataset = data.read(files)
            if len(dataset) != len(files):  # type: ignore[arg-type]
                raise DataError(
                    f"{files[0]} … {files[-1]}: {len(files)} files hold {len(dataset)} samples; "  # type: ignore[arg-type]
                    "mode=encode wants one of each. Split the files."
                )
            batches = Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=0)
            found: list[Tensor] = []
            for batch in batches.of(dataset):
                features = batch["input"]
                if not encoders:
                    encoders = chain(config["encoder"], tuple(features.shape[1:]), data.columns)
                for encoder in encoders:
                    features = encoder(features)
                found.append(features)
                work.advance(len(features))
            content = io.BytesIO()
            np.save(content, torch.cat(found).numpy(), allow_pickle=False)
            write_whole(collection.path(number), content.getvalue())
            written += 1
    return written


def chain(
    parts: Sequence[Mapping[str, Any]], shape: tuple[int, ...], columns: tuple[str, ...]
) -> list[Encoder]:
    """Return the encoders, each built for the features that the encoder before it returns.

    Raises:
        ConfigError: An encoder learns, or draws random numbers.
    """
    found: list[Encoder] = []
    for part in parts:
        encoder: Encoder = build("encoder", part, input_shape=shape, input_columns=columns)
        if not encoder.fixed:
            raise ConfigError(
                f"encoder {part['name']} learns, or draws what it says; mode=encode keeps features that follow from "
                "the input alone. Leave it out, and train it on the features."
            )
        found.append(encoder.eval())
        shape, columns = encoder.output_shape, ()
    return found
