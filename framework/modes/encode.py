"""mode=encode: compute the features of many files in parts; several jobs can share them, and a job can be resumed."""

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
"""Two files beside the features: settings of the computation, and names of the encoded files, one per line."""


class EncodeOptions(Options):
    """Options of mode=encode: the files, the folder for the features, files per part, and this job's share of parts."""

    files: str
    into: str
    part: Annotated[int, Field(gt=0)] = 1000
    share: Annotated[str, Field(pattern=r"^[1-9]\d*/[1-9]\d*$")] = "1/1"


@dataclass(frozen=True)
class Collection:
    """Files to encode, and the folder for their features. The features of `part` files are written to one file, a part.

    Attributes:
        root: Folder to which the names are relative.
        names: Names of the files, in order.
        part: Number of files in a part.
        into: Folder for the features.
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
        """Return the files of part `number`, counted from 0."""
        return [self.root / name for name in self.names[number * self.part : (number + 1) * self.part]]

    def path(self, number: int) -> Path:
        """Return the path of the file for the features of part `number`."""
        return self.into / f"part-{number:06}.npy"

    def missing(self) -> list[int]:
        """Return the numbers of the parts that are not written yet."""
        return [number for number in range(self.parts) if not self.path(number).is_file()]


def run(config: Config) -> None:
    """Compute and write this job's parts of the features; parts that already exist are left unchanged."""
    options = config.options(EncodeOptions)
    console = set_up_process(config.settings)
    parts = {
        "data": resolve("data", config.settings.data or {}),
        "encoder": [
            resolve("encoder", part, f"encoder.{key}")
            for key, part in (config.settings.encoder or {}).items()
        ],
    }
    if not parts["encoder"]:
        raise ConfigError(
            "mode=encode needs an encoder, but none is chosen. Add encoder=[...]; mode=plugins lists the encoders."
        )
    collection = collect_files(
        Path(options.files).expanduser(), Path(options.into).expanduser(), options.part
    )
    require_enclosed(collection.into, ConfigError)
    files = [collection.root / name for name in collection.names]
    readable, unreadable = select_files(build("data", parts["data"]), files, parts["data"], console)
    collection = replace(
        collection, names=[file.relative_to(collection.root).as_posix() for file in readable]
    )
    part_numbers = parts_of_job(collection.parts, options.share)
    with open_run(config) as run:
        record_citations(run, parts)
        describe(collection, parts)
        try:
            written = encode(collection, parts, part_numbers, config.settings)
        except BaseException:
            # Without any part, remove the description, because another attempt may use other settings.
            if len(collection.missing()) == collection.parts:
                for name in (DESCRIPTION, NAMES):
                    (collection.into / name).unlink(missing_ok=True)
            raise
        describe(collection, parts)  # written again if another job failed meanwhile and removed it
        if unreadable:
            left_out = "".join(f"{spell_name(file.relative_to(collection.root))}\n" for file in unreadable)
            write_whole(collection.into / UNREADABLE, left_out.encode())
        missing = len(collection.missing())
        console.print(
            f"{written} parts written, {len(part_numbers) - written} of this job's {len(part_numbers)} parts existed "
            f"already; {missing} of all {collection.parts} parts are missing in {collection.into}",
            soft_wrap=True,
        )


def parts_of_job(parts: int, which: str) -> range:
    """Return the numbers, from 0, of a job's parts: for `which="2/4"`, every fourth part from the second on.

    Raises:
        ConfigError: The number of the job exceeds the number of jobs.
    """
    number, jobs = map(int, which.split("/"))
    if number > jobs:
        raise ConfigError(
            f"mode.share={which}: there is no job {number} of {jobs}. Use 1/{jobs} to {jobs}/{jobs}."
        )
    return range(number - 1, parts, jobs)


def collect_files(root: Path, into: Path, part: int) -> Collection:
    """Collect all files of a folder and its subfolders, except hidden ones, sorted by name.

    Raises:
        DataError: There are no files.
        ConfigError: The folder for the features lies inside the folder of the files.
    """
    if into.resolve().is_relative_to(root.resolve()):
        raise ConfigError(
            f"mode.into={into} lies inside mode.files={root}, so the features would be read as files. Set mode.into "
            "to a folder outside of mode.files."
        )
    paths = (path.relative_to(root) for path in root.rglob("*") if path.is_file())
    names = sorted(
        path.as_posix() for path in paths if not any(piece.startswith(".") for piece in path.parts)
    )
    if not names:
        raise DataError(
            f"mode.files={root} is no folder with files. Set mode.files to the folder whose files are to be encoded."
        )
    return Collection(root, names, part, into)


def describe(collection: Collection, config: Mapping[str, Any]) -> None:
    """Write the description of the stored features into their folder, or check it against an existing description.

    Raises:
        ConfigError: The folder contains features of other input files, or features that were made with other settings.
    """
    text = "".join(f"{spell_name(name)}\n" for name in collection.names).encode()
    description = {
        "version": 1,
        **config,
        "part": collection.part,
        "files": len(collection.names),
        "names": hashlib.sha256(text).hexdigest(),
    }
    collection.into.mkdir(parents=True, exist_ok=True)
    path = collection.into / DESCRIPTION
    if path.is_file():
        existing = read_json(
            path, "the description of encoded files", "Delete the file, or set mode.into to another folder."
        )
        for key, value in description.items():
            if existing.get(key) != value:
                raise ConfigError(
                    f"{path} says {key} = {existing.get(key)}, but this job has {key} = {value}, so the parts in the "
                    "folder do not belong to this job. Use the same files and settings, or set mode.into to another "
                    "folder."
                )
        return
    write_whole(collection.into / NAMES, text)
    write_whole(path, json.dumps(description, indent=1).encode())


@torch.no_grad()
def encode(
    collection: Collection, config: Mapping[str, Any], part_numbers: Sequence[int], settings: Settings
) -> int:
    """Write the missing parts of a job, each atomically, and return their number.

    Args:
        collection: Files to encode.
        config: Resolved configs of the data set and the encoders.
        part_numbers: Numbers of the parts of this job.
        settings: Settings of the command.

    Raises:
        ConfigError: An encoder is trained, or there is no encoder.
        DataError: A file cannot be read, or holds several samples; the message names it. Earlier parts are kept.
    """
    if not config["encoder"]:
        raise ConfigError(
            "mode=encode needs an encoder, but none is chosen. Add encoder=[...]; mode=plugins lists the encoders."
        )
    data: Data = build("data", config["data"])
    encoders: list[Encoder] = []
    written = 0
    with Work("encoding", sum(len(collection.files(number)) for number in part_numbers), "files") as work:
        for number in part_numbers:
            files = collection.files(number)
            if collection.path(number).is_file():
                work.advance(len(files))
                continue
            dataset = data.read(files)
            sample_count: int = len(dataset)  # type: ignore[arg-type]
            if sample_count != len(files):
                raise DataError(
                    f"{files[0]} … {files[-1]}: {len(files)} files contain {sample_count} samples, but mode=encode "
                    "needs one sample per file. Split files with several samples, and leave out files without a "
                    "sample."
                )
            batches = Batches(data, batch_size=settings.batch_size, workers=settings.workers, seed=0)
            part_features: list[Tensor] = []
            for batch in batches.of(dataset):
                features = batch["input"]
                if not encoders:
                    encoders = build_encoders(config["encoder"], tuple(features.shape[1:]), data.columns)
                for encoder in encoders:
                    features = encoder(features)
                part_features.append(features)
                work.advance(len(features))
            content = io.BytesIO()
            np.save(content, torch.cat(part_features).numpy(), allow_pickle=False)
            write_whole(collection.path(number), content.getvalue())
            written += 1
    return written


def build_encoders(
    parts: Sequence[Mapping[str, Any]], shape: tuple[int, ...], columns: tuple[str, ...]
) -> list[Encoder]:
    """Return the encoders, each built for the features that the encoder before it returns.

    Raises:
        ConfigError: An encoder is trained, or uses random numbers.
    """
    encoders: list[Encoder] = []
    for part in parts:
        encoder: Encoder = build("encoder", part, input_shape=shape, input_columns=columns)
        if not encoder.fixed:
            raise ConfigError(
                f"Encoder {part['name']} is trained or uses random numbers, but mode=encode stores features that "
                "depend on the input only. Leave this encoder out, and train it on the stored features."
            )
        encoders.append(encoder.eval())
        shape, columns = encoder.output_shape, ()
    return encoders
