"""mode=sync: send to the tracking store the journal lines that runs could not send themselves."""

from pathlib import Path

from framework.configuration.config import Config, Options
from framework.errors import ConfigError, UserError, count_of
from framework.runs.job import find_job_folders
from framework.storage.progress import PlainConsole
from framework.tracking.ended import sync


class SyncOptions(Options):
    """Options of mode=sync: the folder of the run, or of the sweep, whose journals are sent."""

    run: str


def run(config: Config) -> None:
    """Send the journals of the run or the sweep in the folder `mode.run`, and print the number of lines sent.

    Raises:
        ConfigError: There is no run.
        UserError: A journal could not be sent; the others were sent.
    """
    folder = Path(config.options(SyncOptions).run).expanduser()
    jobs = [job for job in find_job_folders(folder) if job != folder]
    runs = [run for run in (folder, *jobs) if (run / "run.json").is_file()]
    if not runs:
        raise ConfigError(
            f"mode.run={folder} is not a run folder, because {folder / 'run.json'} does not exist. Set mode.run to the "
            "folder of a run or of a sweep."
        )
    errors: list[UserError] = []
    for run in runs:
        try:
            lines = sync(run, config.settings.logger.uri)
        except UserError as error:
            errors.append(error)
        else:
            PlainConsole().print(
                f"{count_of(lines, 'journal line')} sent from {run}.", soft_wrap=True, highlight=False
            )
    if len(errors) == 1:
        raise errors[0]
    if errors:
        raise UserError("\n".join(map(str, errors)))
