"""Folders of shards: the inputs of very many samples in a few .npy files, which are read through memory maps.

`mode=encode` writes such a folder (`mode.pack=true`), and reads it in place of single files. Shard number n is the file
part-00000n.npy, an array (samples, *input_shape). Every shard but the last holds equally many samples. A point cloud
with fewer points than others of its shard ends with rows of NaN. The index encoding.json describes the folder:

- "version": 1;
- "files": number of all samples;
- "part": number of samples in a shard;
- "columns": names of the numbers in the last dimension, if they have names;
- "data": config of the data set that has read the files, if `mode=encode` wrote the folder.

Other programs can write the folder too: the arrays with `numpy.save`, and an index with the first three entries. A
folder may come from an untrusted source, so links are refused, no object is unpickled, and memory is used only for the
samples of a batch.
"""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from framework.errors import DataError, shorten
from framework.storage.arrays import map_npy
from framework.storage.enclosed import read_plain
from framework.storage.limits import LONGEST_NAME, MOST_COLUMNS
from framework.storage.plain_values import LARGEST_JSON, read_json
from framework.storage.reading import translate_errors

INDEX = "encoding.json"
REMEDY = 'Write an index such as {"version": 1, "files": 100000, "part": 1000, "columns": ["x", "y", "z"]}.'
MOST_SAMPLES, MOST_SHARDS = 10**12, 10**6
"""Largest numbers of samples and of shards in an index."""


def part_name(number: int) -> str:
    """Return the name of the file of shard `number`, counted from 0."""
    return f"part-{number:06}.npy"


@dataclass(frozen=True)
class Shards:
    """Inputs of samples in a folder of shards.

    Attributes:
        folder: The folder.
        samples: Number of all samples.
        part: Number of samples in a shard; the last shard may hold fewer.
        columns: Names of the numbers in the last dimension of an input; () if they have none.
        data: Config of the data set that has read the files; None if another program wrote the folder.
        digest: Hash of the index.
    """

    folder: Path
    samples: int
    part: int
    columns: tuple[str, ...]
    data: Mapping[str, Any] | None
    digest: str

    def size(self, number: int) -> int:
        """Return the number of samples of shard `number`, counted from 0."""
        return min(self.part, self.samples - number * self.part)

    def read(self, number: int) -> Tensor:
        """Return the inputs of shard `number` as a private memory map, (samples, *input_shape).

        Raises:
            DataError: The shard is missing, damaged, a link, or different from what the index says.
        """
        path = self.folder / part_name(number)
        with translate_errors(path, "a shard", missing="the index of the folder names more shards."):
            array = map_npy(path)
            if array.ndim < 2 or len(array) != self.size(number):
                raise ValueError(
                    f"got an array of shape {array.shape}, but {INDEX} says that the shard holds {self.size(number)} "
                    "samples"
                )
            if self.columns and array.shape[-1] != len(self.columns):
                raise ValueError(
                    f"got an array of shape {array.shape}, but {INDEX} names {len(self.columns)} columns"
                )
            return torch.from_numpy(array)

    def batches(self, number: int, batch_size: int) -> Iterator[Tensor]:
        """Yield the inputs of shard `number` in batches.

        If all clouds of a batch end with rows of padding, the rows that are padding in every cloud are removed.
        """
        for batch in self.read(number).split(batch_size):
            yield trim(batch)


def trim(clouds: Tensor) -> Tensor:
    """Return a batch of clouds without the last rows that are NaN in every cloud; other batches are not changed."""
    if clouds.dim() != 3 or not clouds.is_floating_point() or not clouds[:, -1:].isnan().all():
        return clouds
    used = (~clouds.isnan().all(-1)).any(0).nonzero()
    return clouds[:, : int(used[-1]) + 1] if len(used) else clouds


def is_folder_of_shards(folder: Path) -> bool:
    """Return whether a folder has an index, which may be damaged."""
    return (folder / INDEX).is_file() or (folder / INDEX).is_symlink()


def open_shards(folder: Path) -> Shards:
    """Read and check the index of a folder of shards; the shards themselves are read later.

    Raises:
        DataError: The index is missing, damaged or a link, or the folder holds features and not inputs.
    """
    path = folder / INDEX
    with translate_errors(path, "the index of a folder of shards", REMEDY):
        digest = hashlib.sha256(read_plain(path, LARGEST_JSON)).hexdigest()
        index = read_json(path, "the index of a folder of shards", REMEDY)
        columns, data = index.get("columns", []), index.get("data")
        faults = {
            "version": index.get("version") == 1,
            **{
                key: type(index.get(key)) is int and 0 < index[key] <= MOST_SAMPLES
                for key in ("files", "part")
            },
            "columns": isinstance(columns, list)
            and len(columns) <= MOST_COLUMNS
            and all(isinstance(name, str) and len(name) <= LONGEST_NAME for name in columns),
            "data": data is None or isinstance(data, dict),
        }
        for key, valid in faults.items():
            if not valid:
                raise ValueError(f"the entry {key} = {shorten(index.get(key))} is not valid")
        if (shards := -(-index["files"] // index["part"])) > MOST_SHARDS:
            raise ValueError(f"the index names {shards:,} shards, but at most {MOST_SHARDS:,} are read")
    if index.get("encoder"):
        raise DataError(
            f"{path} describes features that mode=encode has computed, not inputs. Give the folder of the files or of "
            "their shards."
        )
    return Shards(folder, index["files"], index["part"], tuple(columns), data, digest)
