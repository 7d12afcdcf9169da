"""Shape and type annotations are checked while tests run, and only then."""

import os
from collections.abc import Iterator

import pytest

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

from jaxtyping import install_import_hook

install_import_hook(["framework", "plugins"], "beartype.beartype")


@pytest.fixture(autouse=True)
def no_store_in_the_environment() -> Iterator[None]:
    """MLflow leaves the address of the store that it last served in the environment; the next test would log there."""
    os.environ.pop("MLFLOW_TRACKING_URI", None)
    yield
    os.environ.pop("MLFLOW_TRACKING_URI", None)
