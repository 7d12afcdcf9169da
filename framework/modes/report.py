"""mode=report: write a report on a run or a sweep, as an HTML page and as tables in Markdown and LaTeX."""

from contextlib import suppress
from pathlib import Path

from framework.configuration.config import Config, Options
from framework.errors import ConfigError
from framework.storage.progress import PlainConsole
from framework.sweeps.pages import write_report


class ReportOptions(Options):
    """Options of mode=report: folder of a run or a sweep, and the folder of the report (None: the same folder)."""

    run: str
    into: str | None


def run(config: Config) -> None:
    """Write the report, and print its files.

    Raises:
        ConfigError: `mode.run` is not a folder, or holds no results.
    """
    options = config.options(ReportOptions)
    folder = Path(options.run).expanduser()
    if not folder.is_dir():
        raise ConfigError(
            f"mode.run={folder} is not a folder. Set mode.run to the folder of a run or a sweep."
        )
    files = write_report(folder, Path(options.into).expanduser() if options.into else folder)
    with suppress(OSError):  # an empty run folder of this command
        config.folder.rmdir()
    PlainConsole(highlight=False).print(f"report: {', '.join(map(str, files))}", soft_wrap=True, markup=False)
