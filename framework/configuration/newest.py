"""Search for the newest run of the working directory, which `checkpoint=last` names."""

import os
from pathlib import Path

from framework.errors import CheckpointError
from framework.storage.enclosed import DEEPEST_FOLDERS

LAST = "last"
MODELS = ("model.ckpt", "best.ckpt", "last.ckpt", "previous.ckpt")


def newest_run(outputs: Path) -> Path:
    """Return the folder of the run below `outputs` whose checkpoints were written last; links are not followed.

    Raises:
        CheckpointError: No run below `outputs` has a checkpoint.
    """
    written: dict[Path, float] = {}
    for name, below, files in os.walk(outputs):
        folder = Path(name)
        times = [(folder / file).lstat().st_mtime for file in files if file in MODELS]
        if folder.name == "checkpoints" and times:
            written[folder.parent] = max(times)
            below.clear()
        if len(folder.relative_to(outputs).parts) > DEEPEST_FOLDERS:
            below.clear()
    if not written:
        raise CheckpointError(
            f"checkpoint={LAST} means the newest run in {outputs}, but no run in that folder has a checkpoint. Train "
            "a model first, or give the folder of another run."
        )
    return max(written, key=lambda folder: (written[folder], str(folder)))
