"""Batches of a data set, in an order that depends only on the seed, the epoch and the model."""

import os
import signal
from collections.abc import Callable, Iterator, Mapping
from dataclasses import KW_ONLY, dataclass
from functools import partial
from types import FrameType
from typing import TYPE_CHECKING, Any, final

import torch
from torch import Tensor
from torch.utils.data import DataLoader, Dataset, Sampler

from framework.data import Batch, Data
from framework.datasets.fields import as_batch
from framework.distributions.class_probabilities import require_labels
from framework.distributions.noise import stable_hash
from framework.errors import ConfigError, DataError
from framework.storage.progress import track_progress
from framework.target import Target
from framework.tracking.signals import SIGNALS

if TYPE_CHECKING:
    import pytorch_lightning as pl

Position = tuple[int, int]
"""Pair (epoch, number of the epoch's next batch), both counted from 0."""


@final
@dataclass(eq=False)
class SeededBatches(Sampler[list[int]]):
    """Sampler that yields the indices of the samples of each batch; with several ranks, those of this rank's slice.

    The order of the samples depends on the seed, the epoch and the model (if several models train together, each has
    its own order), but not on the ranks. Rank r of R takes the r-th of R nearly equal slices of each batch. So all
    ranks have equally many batches, and no sample occurs twice.

    Args:
        length: number of samples.
        batch_size: samples of a batch over all ranks.
        orders: number of independent orders; a batch concatenates one batch of each order.
        position: function from the number of batches of an epoch to the position at which to start. It is called when
            the first batch is requested, not when `iter` is called, because a DataLoader calls `iter` earlier and, with
            workers, once too often.
        seed: seed of the order; None keeps the samples' own order.
        drop_last: leave out the last samples of the order if they do not fill a batch (other samples in each epoch). A
            data set with fewer samples than one batch still makes one smaller batch.

    Raises:
        ConfigError: the batch size is smaller than the number of ranks.
        DataError: there are fewer samples than ranks, or none.
    """

    length: int
    batch_size: int
    _: KW_ONLY
    position: Callable[[int], Position] = lambda batches: (0, 0)
    seed: int | None
    drop_last: bool
    rank: int = 0
    ranks: int = 1
    orders: int = 1

    def __post_init__(self) -> None:
        if self.batch_size < self.ranks:
            raise ConfigError(
                f"batch_size = {self.batch_size} over {self.ranks} devices gives some devices no sample. Set "
                f"batch_size to at least {self.ranks}."
            )
        if self.length < self.ranks:
            raise DataError(
                f"A split has {self.length} samples for {self.ranks} devices, but needs at least one per device. Use "
                "fewer devices or more samples."
            )

    def __len__(self) -> int:
        full, rest = divmod(self.length, self.batch_size)
        # A remainder too small to give each rank a sample joins the batch before it.
        return max(1, full + (not self.drop_last and rest >= self.ranks))

    def __iter__(self) -> Iterator[list[int]]:
        epoch, first = self.position(len(self))
        orders = [epoch_order(self.length, self.seed, epoch, member) for member in range(self.orders)]
        for number in range(first, len(self)):
            yield [sample for order in orders for sample in self._part(order, number)]

    def _part(self, order: list[int], number: int) -> list[int]:
        """Return the samples of this rank in batch `number` of the order `order`."""
        start = number * self.batch_size
        last = number == len(self) - 1
        batch = order[start:] if last and not self.drop_last else order[start : start + self.batch_size]
        return batch[self.rank * len(batch) // self.ranks : (self.rank + 1) * len(batch) // self.ranks]


def epoch_order(length: int, seed: int | None, epoch: int, member: int = 0) -> list[int]:
    """Return the order of `length` samples in an epoch: a permutation that depends on (seed, epoch, member) only.

    Args:
        length: number of samples.
        seed: seed of the order; None keeps the samples' own order.
        epoch: counted from 0.
        member: number, from 0, of the model if several train together; model 0 has the order of a model that trains
            alone.
    """
    if seed is None:
        return list(range(length))
    generator = torch.Generator().manual_seed(stable_hash(seed, "order", epoch, *[member] * bool(member)))
    return torch.randperm(length, generator=generator).tolist()


@final
class Batches:
    """Loaders of a data set's batches for training, validation, test and prediction.

    A resumed training continues with the batch that would have been next. `training.module.LoadedBatches` gives the
    batches to Lightning; this class does not import Lightning, which takes a second and which only training needs.

    Training leaves out the samples that do not fill a batch. Validation, test and prediction use every sample once, in
    the data set's order.

    Args:
        data: a prepared data set.
        batch_size: samples of a batch over all devices.
        workers: number of loading processes of each loader; 0 loads in this process.
        seed: seed of the training order.
        orders: number of models that train together, each with its own order; on a single device only.
    """

    def __init__(
        self,
        data: Data,
        *,
        batch_size: int,
        workers: int,
        seed: int,
        orders: int = 1,
    ) -> None:
        self.data = data
        self.batch_size = batch_size
        self.workers = workers
        self.seed = seed
        self.orders = orders
        self.trainer: pl.Trainer | None = None

    def attach(self, trainer: "pl.Trainer") -> None:
        """Set the trainer, from which the loaders take the starting position, the rank and the device."""
        self.trainer = trainer

    def train_dataloader(self) -> DataLoader[Batch]:
        """Return the loader of the training batches, which starts at the trainer's position in the epoch."""
        orders = self.orders if self.trainer is None or self.trainer.world_size == 1 else 1
        split = self.data.splits().train
        return self._loader(split, position=self._position, seed=self.seed, drop_last=True, orders=orders)

    def val_dataloader(self) -> DataLoader[Batch]:
        """Return the batches of the validation split."""
        return self._loader(self.data.splits().validation, seed=None, drop_last=False)

    def test_dataloader(self) -> DataLoader[Batch]:
        """Return the batches of the test split."""
        return self._loader(self.data.splits().test, seed=None, drop_last=False)

    def of(self, dataset: Dataset[Batch]) -> DataLoader[Batch]:
        """Return batches of any other dataset in the dataset's order; the targets are not checked."""
        return self._loader(dataset, as_batch, seed=None, drop_last=False)

    def _loader(
        self, dataset: Dataset[Batch], collate: Callable[..., Batch] | None = None, **order: Any
    ) -> DataLoader[Batch]:
        trainer = self.trainer
        length: int = len(dataset)  # pyright: ignore[reportArgumentType]
        return DataLoader(
            dataset,
            batch_sampler=SeededBatches(
                length,
                self.batch_size,
                rank=trainer.global_rank if trainer else 0,
                ranks=trainer.world_size if trainer else 1,
                **order,
            ),
            num_workers=self.workers,
            persistent_workers=self.workers > 0,
            worker_init_fn=outlive_signals if self.workers else None,
            collate_fn=collate or partial(collate_with_targets, self.data.target),
            pin_memory=trainer is not None and trainer.strategy.root_device.type == "cuda",
            generator=self._generator(),
        )

    def _generator(self) -> torch.Generator:
        """Return the random generator from which a DataLoader draws the seeds of its workers.

        Without one, a DataLoader would draw these seeds from the global generator at each start.
        """
        return torch.Generator().manual_seed(self.seed)

    def _position(self, batches: int) -> Position:
        """Return the position of the training, from the counters that Lightning stores in a checkpoint.

        `processed` counts the batches of the last *started* epoch whose step was taken. The other counters are not
        used: `completed` is one too low in a checkpoint written at the end of a batch, and `ready` is one too high in a
        checkpoint written after an exception.
        """
        trainer: Any = self.trainer  # Any: Lightning types its counters by a base class that lacks them
        if trainer is None:
            raise ConfigError(
                "The training batches were requested before `attach(trainer)` was called. Call `attach` first."
            )
        limit = trainer.limit_train_batches
        batches = min(batches, limit) if isinstance(limit, int) else int(batches * limit)
        epoch = trainer.fit_loop.epoch_progress.current
        processed = trainer.fit_loop.epoch_loop.batch_progress.current.processed
        if epoch.processed == epoch.started or processed >= batches:
            epoch, first = epoch.started, 0
        else:
            epoch, first = epoch.started - 1, processed
        # `overfit_batches` requires the same few batches in every epoch.
        return (0 if trainer.overfit_batches else epoch), first


def outlive_signals(worker: int) -> None:
    """Let a loading process continue after a signal that all processes of a run receive.

    After the signal, the main process saves its checkpoint, and then ends the loading processes. A second SIGTERM ends
    a loading process at once.
    """
    for number in SIGNALS:
        signal.signal(number, _end_at_second if number == signal.SIGTERM else signal.SIG_IGN)


def _end_at_second(number: int, frame: FrameType | None) -> None:
    signal.signal(number, lambda *_: os._exit(0))


def collate_with_targets(target: Target, items: Mapping[str, Tensor] | list[Batch]) -> Batch:
    """Return samples as a batch (`as_batch`), after `require_targets` has compared its targets with `target`."""
    return require_targets(as_batch(items), target)


def require_targets(batch: Batch, target: Target) -> Batch:
    """Return the batch unchanged if its targets have the shape and labels that `target` describes.

    Targets of another shape would be broadcast in the loss without an error.

    Raises:
        DataError: the targets have another shape, or a label belongs to no class.
    """
    values, expected = batch["target"], (len(batch["input"]), *target.event_shape)
    if tuple(values.shape) != expected:
        raise DataError(
            f'The data set gives {expected[0]} samples a "target" of shape {tuple(values.shape)}, but shape {expected} '
            f"is required for targets of kind {target.kind!r} ({target.listed_names}). Correct the data set or its "
            "`target`."
        )
    if target.kind == "class":
        require_labels(values, len(target.names))
    return batch


def track_batches(loader: DataLoader[Batch], activity: str) -> Iterator[Batch]:
    """Yield the batches of a loader, and show the user how many samples have been processed.

    Args:
        loader: the batches.
        activity: name of the activity.
    """
    samples: int = len(loader.dataset)  # type: ignore[arg-type]
    return track_progress(loader, activity, samples, "samples", lambda batch: len(batch["input"]))
