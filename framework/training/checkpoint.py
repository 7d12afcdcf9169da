"""Lightning's interface to checkpoints that are written atomically (framework.storage.checkpoints)."""

from pathlib import Path
from typing import Any, final

from pytorch_lightning.plugins.io import CheckpointIO

from framework.storage import checkpoints


@final
class WholeCheckpoints(CheckpointIO):
    """Plugin of Lightning that writes checkpoints atomically: a file is always complete, the old or the new one."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | Path, storage_options: object = None
    ) -> None:
        """Write a checkpoint to `path`; `storage_options` is ignored."""
        checkpoints.write(checkpoint, Path(path))

    def load_checkpoint(
        self, path: str | Path, map_location: object = None, weights_only: bool | None = None
    ) -> dict[str, Any]:
        """Return the checkpoint at `path`, of plain values and tensors on the CPU; other arguments are ignored."""
        return checkpoints.read(Path(path))

    def remove_checkpoint(self, path: str | Path) -> None:
        """Delete a checkpoint, if it exists."""
        Path(path).unlink(missing_ok=True)
