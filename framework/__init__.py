"""An experiment framework for robust and efficient visual learning; `python -m framework --help` says what it runs."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from framework.frozen import freeze as freeze
    from framework.loading import load as load

__all__ = ["freeze", "load"]
__version__ = "0.1.0"


def __getattr__(name: str) -> object:
    # Lazy, so that `import framework` (and with it `--help`) stays free of torch.
    if name == "load":
        from framework.loading import load

        return load
    if name == "freeze":
        from framework.frozen import freeze

        return freeze
    raise AttributeError(f"module 'framework' has no attribute {name!r}")
