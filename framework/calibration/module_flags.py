"""One flag of some of a model's modules, otherwise for a while: dropout that acts in evaluation, batch norm that learns
nothing from inputs which are not training data."""

from collections.abc import Iterator
from contextlib import contextmanager

from torch import nn


@contextmanager
def flagged(
    model: nn.Module, kinds: type[nn.Module] | tuple[type[nn.Module], ...], flag: str, value: bool
) -> Iterator[None]:
    """In here `flag` ("training", say) of the model's modules of these kinds is `value`; afterwards, also after an
    error, it is of each what it was."""
    before = [(module, getattr(module, flag)) for module in model.modules() if isinstance(module, kinds)]
    try:
        for module, _ in before:
            setattr(module, flag, value)
        yield
    finally:
        for module, was in before:
            setattr(module, flag, was)
