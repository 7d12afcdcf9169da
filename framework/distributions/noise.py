"""Seeds of random noise, set from (seed, step) in training and from (seed, batch, quantity) in evaluation."""

import hashlib
import random
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import torch

from framework.storage.names import as_bytes


@dataclass(frozen=True)
class Draw:
    """Random noise for one batch in evaluation; the noise of a quantity does not depend on the other quantities.

    Attributes:
        seed: seed of the run.
        number: number of the batch.
    """

    seed: int
    number: int

    @contextmanager
    def __call__(self, quantity: str) -> Iterator[None]:
        """Seed the random generators for `quantity` in a `with` block; torch's generators are restored at its end."""
        devices = [torch.cuda.current_device()] if torch.cuda.is_initialized() else []
        with torch.random.fork_rng(devices):
            seed_step(self.seed, self.number, quantity)
            yield


def seed_step(seed: int, step: int, stage: str, rank: int = 0) -> None:
    """Seed all random generators, so that the following noise depends on (seed, step, stage, rank) alone.

    The generators are torch's for CPU and CUDA, NumPy's legacy generator and Python's. Seeding all of them takes 7 µs;
    Python's generator alone takes 3 µs.

    Args:
        seed: seed of the run.
        step: number of the batch. It is not the number of the optimiser's step, because all batches whose gradients
            are accumulated for one step would then have the same noise.
        stage: name of what the noise is used for, such as "train" or "validation".
        rank: number of the process, if several processes train one model; 0 for a single process.
    """
    value = stable_hash(seed, stage, step, rank)
    # torch.manual_seed is not used: where CUDA is not in use it formats the stack for a later report, 100 µs.
    torch.default_generator.manual_seed(value)
    if torch.cuda.is_initialized():
        torch.cuda.manual_seed(value)
    np.random.seed(value % 2**32)  # noqa: NPY002  (the global generator is the point)
    random.seed(value)


def stable_hash(*parts: int | str) -> int:
    """Return a 64-bit hash of `parts` in their order, which is the same on every machine."""
    digest = hashlib.blake2b(as_bytes("|".join(map(str, parts))), digest_size=8).digest()
    return int.from_bytes(digest, "little")
