"""mode=sync: send to the tracking store the journal lines that a run could not send itself."""

from pathlib import Path

from rich.console import Console

from framework.configuration.config import Config, Options
from framework.errors import ConfigError
from framework.tracking.ended import sync


class SyncOptions(Options):
    """Options of mode=sync: the folder of the run whose journal is sent."""

    run: str


def run(config: Config) -> None:
    """Send the journal of `mode.run`, and print the number of lines sent."""
    folder = Path(config.options(SyncOptions).run).expanduser()
    if not (folder / "run.json").is_file():
        raise ConfigError(
            f"mode.run={folder} is no run folder, because {folder / 'run.json'} does not exist. Set mode.run to the "
            "folder of a run."
        )
    Console().print(f"{sync(folder, config.settings.logger.uri)} journal lines sent from {folder}.")
