"""An experiment framework for robust and efficient visual learning; `python -m framework --help` lists its commands."""

# This file imports only modules that Python has already loaded: `python -m` would look for any other module in the
# working directory until `__main__` forbids it.
import sys
from importlib import import_module
from importlib.machinery import ModuleSpec

TYPE_CHECKING = False
if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import ModuleType

    from framework.configuration.loading import load as load
    from framework.deployment.frozen import freeze as freeze

__all__ = ["freeze", "load"]
__version__ = "0.2.0"

_LAZY = {"load": "framework.configuration.loading", "freeze": "framework.deployment.frozen"}


def __getattr__(name: str) -> object:
    # Lazy, so that `import framework` (and with it `--help`) stays free of torch.
    if name in _LAZY:
        return getattr(import_module(_LAZY[name]), name)
    raise AttributeError(f"module 'framework' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


_CURRENT_NAMES = {
    f"framework.{old}": f"framework.{new}"
    for old, new in {
        "cache": "storage.cache",
        "camera": "geometry.camera",
        "cdf": "distributions.protocol",
        "circular": "distributions.circular",
        "circular_moments": "distributions.circular_moments",
        "class_probabilities": "distributions.class_probabilities",
        "clouds": "geometry.clouds",
        "density": "distributions.density",
        "fields": "datasets.fields",
        "generated": "storage.generated",
        "images": "datasets.images",
        "meshes": "geometry.meshes",
        "module_flags": "calibration.module_flags",
        "monte_carlo": "distributions.protocol",
        "nan": "distributions.checks",
        "nearest": "geometry.nearest",
        "normals": "distributions.protocol",
        "raw_numbers": "heads.parameters",
        "rearranged": "distributions.batch_shapes",
        "rotation": "geometry.rotation",
        "runs.description": "configuration.description",
        "runs.loading": "configuration.loading",
        "temper": "distributions.tempering",
        "validation": "calibration.validation",
    }.items()
}
"""Old names of modules that plugins import, and the current names of these modules."""


class _OldNameFinder:
    """Finder that makes the old name of a module refer to the module itself, not to a copy."""

    def find_spec(
        self, fullname: str, path: "Sequence[str] | None", target: "ModuleType | None" = None
    ) -> "ModuleSpec | None":
        return ModuleSpec(fullname, self) if fullname in _CURRENT_NAMES else None  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> "ModuleType":
        module = import_module(_CURRENT_NAMES[spec.name])
        self.spec = module.__spec__
        return module

    def exec_module(self, module: "ModuleType") -> None:
        module.__spec__ = self.spec  # the import system has just replaced it by the spec of the old name


sys.meta_path.append(_OldNameFinder())
