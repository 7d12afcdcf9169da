"""Temporary modes of modules: evaluation of a model, or a flag on selected modules, such as active dropout."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn

BATCH_NORM = (
    *(nn.BatchNorm1d, nn.BatchNorm2d, nn.BatchNorm3d, nn.SyncBatchNorm),
    *(nn.LazyBatchNorm1d, nn.LazyBatchNorm2d, nn.LazyBatchNorm3d),
)
"""All batch-norm classes of torch."""


@contextmanager
def evaluation_mode(model: nn.Module) -> Iterator[None]:
    """Set a model to evaluation mode inside the `with` block.

    After the block, also after an error, the model has the mode again that it had before.
    """
    training = model.training
    try:
        model.eval()
        yield
    finally:
        model.train(training)


@contextmanager
def set_flag(
    model: nn.Module, kinds: type[nn.Module] | tuple[type[nn.Module], ...], flag: str, value: bool
) -> Iterator[None]:
    """Set `flag`, for example "training", to `value` on all modules of the classes `kinds` inside the `with` block.

    After the block, also after an error, the flag of each module has the value again that it had before.
    """
    before = [(module, getattr(module, flag)) for module in model.modules() if isinstance(module, kinds)]
    try:
        for module, _ in before:
            setattr(module, flag, value)
        yield
    finally:
        for module, was in before:
            setattr(module, flag, was)
