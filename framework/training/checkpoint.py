"""Lightning's door to checkpoints that are whole or absent (framework.storage.checkpoints)."""

from pathlib import Path
from typing import Any, final

from pytorch_lightning.plugins.io import CheckpointIO

from framework.storage import checkpoints

TRAINED = {"last.ckpt", "previous.ckpt"}
"""Checkpoints that training can go on from; the others hold weights alone."""
BEST = "best.ckpt"


@final
class WholeCheckpoints(CheckpointIO):
    """Saves so that the file under the final name is the new checkpoint or the old one, never a part of one."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        checkpoints.write(checkpoint, Path(path))

    def load_checkpoint(
        self, path: str | Path, map_location: object = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """`read(path)`: on the CPU and plain values only, whatever Lightning asks for."""
        return checkpoints.read(Path(path))

    def remove_checkpoint(self, path: str | Path) -> None:
        Path(path).unlink(missing_ok=True)


def trained(folder: Path) -> Path | None:
    """The newest good checkpoint in a folder that training can go on from; None where there is none."""
    found = checkpoints.latest_good(folder, names=TRAINED)
    if found is not None:
        return found
    best = checkpoints.latest_good(folder, names={BEST})
    # version 0.1 wrote it whole
    return best if best is not None and "optimizer_states" in checkpoints.read(best) else None
