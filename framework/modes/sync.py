"""mode=sync: send to the tracking store what a run could not send while it ran."""

from pathlib import Path
from typing import Any

from rich.console import Console

from framework.configuration.settings import Settings
from framework.errors import ConfigError
from framework.tracking.tracker import sync


def run(values: dict[str, Any], settings: Settings, folder: Path, overrides: list[str]) -> None:
    """Replay the journal of `mode.run`."""
    target = Path(str(values["mode"]["run"])).expanduser()
    if not (target / "run.json").is_file():
        raise ConfigError(
            f"mode.run={target}: {target / 'run.json'} does not exist. Give the folder of a run."
        )
    sent = sync(target)
    Console().print(f"{sent} journal lines sent from {target}.")
