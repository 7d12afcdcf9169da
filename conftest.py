"""The tests' environment: one thread, no store, no cluster; shape and type annotations are checked where asked for.

`CHECK_TYPES=1 pytest` checks the shapes and types of every call (jaxtyping, beartype), which costs a quarter more time.
`.ci/run` does so in a step of its own.
"""

import gc
import os
from collections.abc import Generator, Iterator

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

if os.environ.get("CHECK_TYPES", "0") != "0":
    from jaxtyping import install_import_hook

    install_import_hook(["framework", "plugins"], "beartype.beartype")


@pytest.fixture(autouse=True)
def no_store_in_the_environment() -> Iterator[None]:
    """MLflow leaves the address of the store that it last served in the environment; the next test would log there."""
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    yield
    os.environ.pop("MLFLOW_TRACKING_URI", None)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Generator[None, object, object]:
    """Keep what the collected tests import out of every later garbage collection, which would visit it each time."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()
