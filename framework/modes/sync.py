"""mode=sync: send to the tracking store what a run could not send while it ran."""

from pathlib import Path

from rich.console import Console

from framework.configuration.config import Config, Options
from framework.errors import ConfigError
from framework.tracking.ended import sync


class SyncOptions(Options):
    """Whose journal to send."""

    run: str


def run(config: Config) -> None:
    """Replay the journal of `mode.run`."""
    folder = Path(config.options(SyncOptions).run).expanduser()
    if not (folder / "run.json").is_file():
        raise ConfigError(
            f"mode.run={folder}: {folder / 'run.json'} does not exist. Give the folder of a run."
        )
    Console().print(f"{sync(folder, config.settings.logger.uri)} journal lines sent from {folder}.")
