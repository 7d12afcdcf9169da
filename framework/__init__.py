"""An experiment framework for robust and efficient visual learning; `python -m framework --help` lists its commands."""

# This file imports only modules that Python has already loaded: `python -m` would look for any other module in the
# working directory until `__main__` forbids it.
from importlib import import_module

TYPE_CHECKING = False
if TYPE_CHECKING:
    from framework.deployment.frozen import freeze as freeze
    from framework.deployment.loaded import load as load

__all__ = ["freeze", "load"]
__version__ = "0.2.0"

_LAZY = {"load": "framework.deployment.loaded", "freeze": "framework.deployment.frozen"}


def __getattr__(name: str) -> object:
    # Lazy, so that `import framework` (and with it `--help`) stays free of torch.
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'framework' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
