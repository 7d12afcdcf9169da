"""The tests' environment: one thread, no store, no cluster; shape and type annotations are checked where asked for.

`CHECK_TYPES=1 pytest` checks the shapes and types of every call (jaxtyping, beartype), which costs a quarter more time.
`.ci/run` does so in a step of its own.
"""

import gc
import inspect
import os
from collections.abc import Callable, Generator, Iterator
from functools import partial
from pathlib import Path
from typing import Any, ForwardRef, get_args

import jaxtyping
import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")
RANKS = ("RANK", "LOCAL_RANK", "NODE_RANK", "WORLD_SIZE")
"""Variables of a job of several processes; those of SLURM have a prefix."""
SHOWN = ("FORCE_COLOR", "NO_COLOR", "COLUMNS", "LINES")
"""Variables that change what is printed."""
for name in [
    *os.environ
]:  # neither the job nor the terminal that the tests run in is that of what they start
    if name.startswith("SLURM_") or name in (*RANKS, *SHOWN):
        del os.environ[name]
os.environ["TERM"] = "xterm"


def names_shapes(annotation: Any) -> bool:
    """Return whether an annotation contains an array of a given shape, or text that may stand for one."""
    if isinstance(annotation, str | ForwardRef):
        return True
    if inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    return any(map(names_shapes, get_args(annotation)))


def install_type_checks() -> None:
    """Check shapes and types of each call of the project's functions.

    jaxtyping compares the shapes of arguments and result. It binds the arguments of each call for that, which takes ten
    times as long as the checks of their types. So beartype alone checks functions without any shape in their signature.
    """
    check_shapes = jaxtyping.jaxtyped

    def check(function: Any, *, typechecker: Any) -> Any:
        if inspect.isfunction(function) and not any(map(names_shapes, function.__annotations__.values())):
            return typechecker(function)
        return check_shapes(function, typechecker=typechecker)

    def choose_check(*, typechecker: Any) -> Callable[[Any], Any]:
        return partial(check, typechecker=typechecker)

    jaxtyping.jaxtyped = choose_check
    jaxtyping.install_import_hook(["framework", "plugins"], "beartype.beartype")


if os.environ.get("CHECK_TYPES", "0") != "0":
    install_type_checks()


def pytest_xdist_auto_num_workers() -> int:
    """Return one worker more than cores for `pytest -n logical`: tests wait for a tenth of their time."""
    return (os.cpu_count() or 1) + 1


@pytest.fixture(autouse=True)
def no_store_in_the_environment() -> Iterator[None]:
    """MLflow leaves the address of the store that it last served in the environment; the next test would log there."""
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    yield
    os.environ.pop("MLFLOW_TRACKING_URI", None)


@pytest.fixture(scope="session")
def doll_images() -> Any:
    """Prepared images of a doll of which poses are estimated."""
    from framework.testing.bodies import DOLL
    from framework.testing.data_samples import prepared

    sizes = {"train": 3, "validation": 2, "test": 6, "height": 48, "width": 40}
    return prepared("pose_from_image", renderer={"name": "rasterizer", "supersampling": 4}, **sizes, **DOLL)


@pytest.fixture(scope="session")
def brain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """File of one generated slice of Z-spectra, which tests must not change."""
    from plugins.data.cest.generator import write_slice

    folder = tmp_path_factory.mktemp("brain")
    write_slice(folder, side=40, noise=0.01, shift=0.08, data_seed=0)
    return folder / "brain.npz"


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep what the collected tests import out of every later garbage collection, which would visit it each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
