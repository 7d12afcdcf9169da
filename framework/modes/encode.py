"""mode=encode: compute the features of many samples in parts; several jobs can share them, and a job can be resumed.

The samples are the files of a folder, or a folder of shards (`framework.datasets.shards`). With `mode.pack=true` the
mode writes the inputs themselves, which makes shards of files.
"""

import hashlib
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from framework.configuration.config import Config, Options
from framework.configuration.modes import idle_sentence
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.datasets.shards import INDEX, Shards, is_folder_of_shards, open_shards, part_name
from framework.encoder import Encoder, FitsInputs
from framework.errors import ConfigError, DataError, count_of, quote
from framework.geometry.clouds import pad
from framework.runs.introduction import introduce_threads, print_lines
from framework.runs.job import refuse_idle
from framework.runs.run import open_run
from framework.runs.session import record_citations, set_up_process
from framework.runs.user_files import UNREADABLE, select_files
from framework.storage.enclosed import add_data_folder, require_enclosed
from framework.storage.files import remove_leftovers, replacing, write_whole
from framework.storage.names import spell_name
from framework.storage.plain_values import read_json
from framework.storage.progress import Work, output
from framework.training.batches import Batches

DESCRIPTION, NAMES = INDEX, "files.txt"
"""Names of two files beside the features: one holds the settings of the computation, one the encoded files' names."""


class EncodeOptions(Options):
    """Options of mode=encode.

    Attributes:
        files: Folder of the files, or folder of shards.
        into: Folder for the features.
        part: Number of files that are encoded and stored together.
        share: Share of the parts that this job computes, such as "2/4": every fourth part, from the second on.
        pack: Whether to write the inputs themselves, as shards.
    """

    files: str
    into: str
    part: Annotated[int, Field(gt=0)] = 1000
    share: Annotated[str, Field(pattern=r"^[1-9]\d*/[1-9]\d*$")] = "1/1"
    pack: bool = False


@dataclass(frozen=True)
class Files:
    """Source of one sample per file.

    Attributes:
        root: Folder to which the names are relative.
        names: Names of the files, in order.
        part: Number of files that are encoded and stored together.
        data: Data set that reads the files.
        workers: Number of data-loading processes.
    """

    root: Path
    names: Sequence[str]
    part: int
    data: Data
    workers: int = 0

    @property
    def columns(self) -> tuple[str, ...]:
        """Return the names of the numbers in the last dimension of an input; () if they have none."""
        return self.data.columns

    @property
    def samples(self) -> int:
        """Return the number of files."""
        return len(self.names)

    @property
    def text(self) -> bytes:
        """Return the names of the files as the content of a text file, one per line."""
        return "".join(f"{spell_name(name)}\n" for name in self.names).encode()

    @property
    def digest(self) -> str:
        """Return a hash of the names of the files."""
        return hashlib.sha256(self.text).hexdigest()

    def files(self, number: int) -> list[Path]:
        """Return the files of part `number`, counted from 0."""
        return [self.root / name for name in self.names[number * self.part : (number + 1) * self.part]]

    def size(self, number: int) -> int:
        """Return the number of files of part `number`, counted from 0."""
        return len(self.files(number))

    def batches(self, number: int, batch_size: int) -> Iterator[Tensor]:
        """Yield the inputs of part `number` in batches.

        Raises:
            DataError: A file cannot be read, or holds several samples; the message names it.
        """
        files = self.files(number)
        dataset = self.data.read(files)
        sample_count: int = len(dataset)  # type: ignore[arg-type]
        if sample_count != len(files):
            raise DataError(
                f"{files[0]} … {files[-1]}: {len(files)} files contain {sample_count} samples, but mode=encode "
                "needs one sample per file. Split files with several samples, and leave out files without a "
                "sample."
            )
        batches = Batches(self.data, batch_size=batch_size, workers=self.workers, seed=0)
        for batch in batches.of(dataset):
            yield batch["input"]


@dataclass(frozen=True)
class Collection:
    """Samples to encode, in parts, and the folder for their features.

    A part is a shard, or a fixed number of consecutive files. Its features are written to one file.

    Attributes:
        source: The samples.
        into: Folder for the features.
    """

    source: Files | Shards
    into: Path

    @property
    def parts(self) -> int:
        """Return the number of parts."""
        return -(-self.source.samples // self.source.part)

    def path(self, number: int) -> Path:
        """Return the path of the file for the features of part `number`."""
        return self.into / part_name(number)

    def missing(self) -> list[int]:
        """Return the numbers of the parts that are not written yet."""
        return [number for number in range(self.parts) if not self.path(number).is_file()]


def run(config: Config) -> None:
    """Compute and write this job's parts of the features; parts that already exist are left unchanged."""
    options = config.options(EncodeOptions)
    console = set_up_process(config.settings)
    root, into = Path(options.files).expanduser(), Path(options.into).expanduser()
    add_data_folder(root)
    shards = open_shards(root) if is_folder_of_shards(root) else None
    parts = {
        "data": resolve("data", config.settings.data or {}) if shards is None else data_of(shards, config),
        "encoder": [
            resolve("encoder", part, f"encoder.{key}")
            for key, part in (config.settings.encoder or {}).items()
        ],
    }
    require_task(options, parts["encoder"], shards)
    require_apart(root, into)
    require_enclosed(into, ConfigError)
    unreadable: list[Path] = []
    if shards is None:
        data: Data = build("data", parts["data"])
        files = collect_files(root)
        readable, unreadable = select_files(data, files, parts["data"], console)
        names = [file.relative_to(root).as_posix() for file in readable]
        collection = Collection(Files(root, names, options.part, data, config.settings.workers), into)
    else:
        collection = Collection(shards, into)
    part_numbers = parts_of_job(collection.parts, options.share)
    introduce_threads(config.settings.threads, console)
    print_lines(describe_work(collection, parts, len(part_numbers)), console)
    with open_run(config) as run:
        record_citations(run, {key: part for key, part in parts.items() if part})
        describe(collection, parts)
        remove_leftovers(into)
        try:
            written = encode(collection, parts, part_numbers, config.settings.batch_size)
        except BaseException:
            # Without any part, remove the description, because another attempt may use other settings.
            if len(collection.missing()) == collection.parts:
                for name in (DESCRIPTION, NAMES):
                    (collection.into / name).unlink(missing_ok=True)
            raise
        describe(collection, parts)  # written again if another job failed meanwhile and removed it
        if unreadable:
            left_out = "".join(f"{spell_name(file.relative_to(root))}\n" for file in unreadable)
            write_whole(collection.into / UNREADABLE, left_out.encode())
        missing = len(collection.missing())
        console.print(
            f"{written} parts written, {len(part_numbers) - written} of this job's {len(part_numbers)} parts existed "
            f"already; {missing} of all {collection.parts} parts are missing in {collection.into}",
            soft_wrap=True,
        )


def describe_work(collection: Collection, parts: Mapping[str, Any], count: int) -> list[str]:
    """Return the lines about the samples that are read, the encoders, and the `count` parts that this job writes."""
    source = collection.source
    if isinstance(source, Files):
        reads = f"reads {count_of(source.samples, 'file')} in {source.root} as {parts['data']['name']}"
    else:
        reads = f"reads {count_of(source.samples, 'sample')} in the shards of {source.folder}"
    names = ", ".join(part["name"] for part in parts["encoder"])
    task = f"encodes them by {names}" if names else "packs them into shards"
    of_job = (
        f"{count} of {count_of(collection.parts, 'part')}, with up to {count_of(source.part, 'sample')} each"
    )
    return [reads, f"{task}, and writes {of_job}, to {collection.into}"]


def data_of(shards: Shards, config: Config) -> Mapping[str, Any] | None:
    """Return the resolved config of the data set that read the files from which shards were made; None if not known.

    Raises:
        ConfigError: The command chooses another data set, or sets a key that only affects the reading of files.
    """
    for key, why in (
        ("mode.part", "a part has as many samples as a shard of mode.files"),
        ("workers", "mode.files is a folder of shards, which need no data-loading processes"),
    ):
        if override := config.first_override(key):
            refuse_idle(config.folder, idle_sentence(override, why))
    stored = None if shards.data is None else resolve("data", shards.data)
    if config.settings.data and (chosen := resolve("data", config.settings.data)) != stored:
        raise ConfigError(
            f"mode.files={shards.folder} is a folder of shards whose inputs were read with data = {quote(stored)}, but "
            f"the command has data = {quote(chosen)}. Leave out the settings of data, or pack the files again."
        )
    return stored


def require_task(options: EncodeOptions, encoders: Sequence[Any], shards: Shards | None) -> None:
    """Require that a command either encodes samples, or packs files into shards.

    Args:
        options: Options of the mode.
        encoders: Chosen encoders.
        shards: Shards that the command reads; None if it reads other files.

    Raises:
        ConfigError: There is no encoder; or the command packs, and has an encoder or reads shards.
    """
    if not options.pack and not encoders:
        raise ConfigError(
            "mode=encode needs an encoder, but none is chosen. Add encoder=[...]; mode=plugins lists the encoders. To "
            "store the inputs themselves, add mode.pack=true."
        )
    if options.pack and encoders:
        raise ConfigError(
            "mode.pack=true stores the inputs themselves, but an encoder is chosen too. Leave out the encoder, and "
            "encode the shards with a second command."
        )
    if options.pack and shards is not None:
        raise ConfigError(
            f"mode.files={options.files} is a folder of shards already. Give the folder of the files, or leave out "
            "mode.pack."
        )


def require_apart(root: Path, into: Path) -> None:
    """Refuse a folder for the features (`into`) that lies inside the folder of the files (`root`).

    Raises:
        ConfigError: The folder for the features lies inside the folder of the files.
    """
    if into.resolve().is_relative_to(root.resolve()):
        raise ConfigError(
            f"mode.into={into} lies inside mode.files={root}, so the features would be read as files. Set mode.into "
            "to a folder outside of mode.files."
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


def collect_files(root: Path) -> list[Path]:
    """Return all files of a folder and its subfolders, except hidden ones, sorted by name.

    Raises:
        DataError: There are no files.
    """
    paths = (path.relative_to(root) for path in root.rglob("*") if path.is_file())
    names = sorted(
        path.as_posix() for path in paths if not any(piece.startswith(".") for piece in path.parts)
    )
    if not names:
        raise DataError(
            f"mode.files={root} is not a folder with files. Set mode.files to the folder whose files are to be encoded."
        )
    return [root / name for name in names]


def describe(collection: Collection, config: Mapping[str, Any]) -> None:
    """Write the description of the stored features into their folder; if there is one already, check that it is equal.

    Args:
        collection: Samples and the folder of the features.
        config: Resolved configs of the data set and of the encoders.

    Raises:
        ConfigError: The folder contains features of other input files, or features that were made with other settings.
    """
    source = collection.source
    description = {
        "version": 1,
        **config,
        "part": source.part,
        "files": source.samples,
        "names": source.digest,
    }
    if not config["encoder"]:
        description["columns"] = list(source.columns)
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
    if isinstance(source, Files):
        write_whole(collection.into / NAMES, source.text)
    write_whole(path, json.dumps(description, indent=1).encode())


@torch.no_grad()
def encode(
    collection: Collection, config: Mapping[str, Any], part_numbers: Sequence[int], batch_size: int
) -> int:
    """Write the missing parts of a job, each atomically, and return their number.

    Args:
        collection: Samples to encode.
        config: Resolved configs of the data set and of the encoders; without an encoder, the inputs themselves are
            written.
        part_numbers: Numbers of the parts of this job.
        batch_size: Number of samples that are encoded together.

    Raises:
        ConfigError: An encoder is trained, or uses random numbers.
        DataError: A file cannot be read, or holds several samples; the message names it. Earlier parts are kept.
    """
    source = collection.source
    encoders: list[Encoder] = []
    written = 0
    with Work("encoding", sum(source.size(number) for number in part_numbers), "files") as work:
        for number in part_numbers:
            if collection.path(number).is_file():
                work.advance(source.size(number))
                continue
            part_features: list[Tensor] = []
            for features in source.batches(number, batch_size):
                if config["encoder"] and not encoders:
                    encoders = build_encoders(config["encoder"], tuple(features.shape[1:]), source.columns)
                    shapes = (
                        "×".join(map(str, shape)) for shape in (features.shape[1:], encoders[-1].output_shape)
                    )
                    print_lines(["first inputs: shape {} each, features: shape {}".format(*shapes)], output())
                for encoder in encoders:
                    features = encoder(features)
                part_features.append(features)
                work.advance(len(features))
            with replacing(collection.path(number)) as partial, partial.open("wb") as stream:
                np.save(stream, join(part_features).numpy(), allow_pickle=False)
            written += 1
    return written


def join(batches: Sequence[Tensor]) -> Tensor:
    """Return several batches as one; point clouds get rows of NaN until all are as long as the largest."""
    if len({batch.shape[1:] for batch in batches}) == 1:
        return torch.cat(list(batches))
    return pad([cloud for batch in batches for cloud in batch])


def build_encoders(
    parts: Sequence[Mapping[str, Any]], shape: tuple[int, ...], columns: tuple[str, ...]
) -> list[Encoder]:
    """Return the encoders, each built for the features that the encoder before it returns.

    Args:
        parts: Resolved configs of the encoders, in the order in which they are applied.
        shape: Shape of one input.
        columns: Names of the numbers in the last dimension of an input; () if they have none.

    Raises:
        ConfigError: An encoder is trained, uses random numbers, or is fitted to training samples.
    """
    encoders: list[Encoder] = []
    for part in parts:
        encoder: Encoder = build("encoder", part, input_shape=shape, input_columns=columns)
        if not encoder.fixed:
            raise ConfigError(
                f"Encoder {part['name']} is trained or uses random numbers, but mode=encode stores features that "
                "depend on the input only. Leave this encoder out, and train it on the stored features."
            )
        if isinstance(encoder, FitsInputs) and encoder.needs_fit:
            raise ConfigError(
                f"Encoder {part['name']} with these settings is fitted to the training split before training, but "
                "mode=encode has no training split. Leave this encoder out, and use it in the training instead."
            )
        encoders.append(encoder.eval())
        shape, columns = encoder.output_shape, ()
    return encoders
