"""torchmetrics, imported without Matplotlib and SciPy's signal processing.

The import of torchmetrics loads both, which takes three times as long as loading its own modules. torchmetrics needs
Matplotlib only for its method `plot`, and SciPy's module only for a metric of speech. The framework uses neither. With
this module, `plot` imports Matplotlib when it is called.
"""

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from importlib import import_module
from types import ModuleType
from typing import Any

PLOTS, SIGNAL = "torchmetrics.utilities.plot", "scipy.signal"


class _Plots(ModuleType):
    """Stand-in for torchmetrics' module of plots, whose functions import the module when they are called."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # a type, which only annotations use
            return Any

        def plot(*arguments: Any, **options: Any) -> Any:
            return getattr(import_module(PLOTS), name)(*arguments, **options)

        return plot


class _Signal(ModuleType):
    """Stand-in for SciPy's module `signal`; it has `hamming`, so that torchmetrics does not try to add this name."""

    hamming = None


@contextmanager
def _standing_in(*modules: ModuleType) -> Iterator[None]:
    """Let imports in the block return these stand-ins, unless the modules that they replace are already loaded."""
    added = [module for module in modules if sys.modules.setdefault(module.__name__, module) is module]
    try:
        yield
    finally:
        for module in added:
            del sys.modules[module.__name__]


with _standing_in(*([] if "torchmetrics" in sys.modules else [_Plots(PLOTS), _Signal(SIGNAL)])):
    import torchmetrics as torchmetrics
