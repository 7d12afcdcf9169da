"""Shape and type annotations are checked while tests run, and only then."""

import os

os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("MLFLOW_DISABLE_TELEMETRY", "true")

from jaxtyping import install_import_hook

install_import_hook(["framework", "plugins"], "beartype.beartype")
