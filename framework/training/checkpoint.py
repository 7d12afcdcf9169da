"""Lightning's interface to checkpoints that are whole or absent (framework.storage.checkpoints)."""

from pathlib import Path
from typing import Any, final

from pytorch_lightning.plugins.io import CheckpointIO

from framework.storage import checkpoints

TRAINED = {"last.ckpt", "previous.ckpt"}
"""Checkpoints that training can resume from; all others hold weights only."""
BEST = "best.ckpt"
"""Name of the checkpoint with the lowest validation loss."""


@final
class WholeCheckpoints(CheckpointIO):
    """Saves checkpoints so that the file under the final name is the new or the old checkpoint, never a part of one."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        """Write a checkpoint."""
        checkpoints.write(checkpoint, Path(path))

    def load_checkpoint(
        self, path: str | Path, map_location: object = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Return `read(path)`, on the CPU and with plain values only, whatever Lightning requests."""
        return checkpoints.read(Path(path))

    def remove_checkpoint(self, path: str | Path) -> None:
        """Delete a checkpoint, if it exists."""
        Path(path).unlink(missing_ok=True)


def trained(folder: Path) -> Path | None:
    """Return the newest undamaged checkpoint in a folder that training can resume from; None if there is none."""
    found = checkpoints.latest_good(folder, names=TRAINED)
    if found is not None:
        return found
    best = checkpoints.latest_good(folder, names={BEST})
    # Version 0.1 wrote it with the state of the optimiser.
    return best if best is not None and "optimizer_states" in checkpoints.read(best) else None
