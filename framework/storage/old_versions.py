"""Handling of run folders and checkpoints of version 0.1, which still load; no other module handles old formats.

The functions fill in or recognise what version 0.1 wrote differently. They do nothing to files of later versions.
"""

from collections.abc import Mapping
from typing import Any

PREDICTION_SETTINGS = {"seed": 0, "samples": 1000}
"""Settings of predictions for a model whose checkpoint contains no settings, as in version 0.1."""


def complete_description(stored: Mapping[str, Any]) -> dict[str, Any]:
    """Return the stored description of a model with the entries that version 0.1 did not write.

    The added entries are empty or False. If the added entry is `data_state`, a data set that needs this state to read
    raw input computes it again from its training data.
    """
    absent = {
        "columns": (),
        "synthetic": False,
        "method": "",
        "settings": {},
        "data_state": {},
        "remarks": (),
    }
    return {**absent, **stored}


def can_resume_from_best(checkpoint: Mapping[str, Any]) -> bool:
    """Return whether best.ckpt contains the state of the optimiser, which only version 0.1 wrote into this file."""
    return "optimizer_states" in checkpoint


def has_checkpoint_files(client: Any, run_id: str) -> bool:
    """Return whether a run in MLflow has its checkpoints as files, as version 0.1 stored them, instead of as a model.

    Args:
        client: MLflow client of the store.
        run_id: Id of the run.
    """
    return bool(client.list_artifacts(run_id, "checkpoints"))


def download_checkpoint_files(client: Any, run_id: str, folder: str) -> None:
    """Download the checkpoints that `has_checkpoint_files` found into a folder."""
    client.download_artifacts(run_id, "checkpoints", folder)
