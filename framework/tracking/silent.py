"""Tracker for processes of a distributed training whose run another process records."""

from collections.abc import Mapping
from pathlib import Path
from typing import final

from framework.tracking.journal import Journal
from framework.tracking.tracker import JOURNAL, Status, Tracker


@final
class SilentTracker(Tracker):
    """Tracker that records nothing, because the first of several ranks that train together records the run.

    Args:
        folder: Folder of the run, whose journal can be read.
    """

    def __init__(self, folder: Path) -> None:
        self.journal = Journal(folder / JOURNAL)  # read, never written

    def open(self) -> None:
        pass

    def log_params(self, flat: Mapping[str, object]) -> None:
        pass

    def set_tags(self, tags: Mapping[str, str | None]) -> None:
        pass

    def log_metrics(self, values: Mapping[str, float], step: int, epoch: int) -> None:
        pass

    def log_dataset(self, name: str, context: str, facts: Mapping[str, str]) -> None:
        pass

    def log_artifact(self, path: Path, folder: str = "") -> None:
        pass

    def drop_after(self, step: int) -> None:
        pass

    def close(self, status: Status) -> None:
        pass

    def leave_open(self) -> None:
        pass

    @property
    def run_id(self) -> None:
        return None

    @property
    def url(self) -> str:
        return ""
