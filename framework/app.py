"""The command line: it composes the config, runs the chosen mode, and reports an error in a sentence."""

import logging
import os
import sys
from collections.abc import Sequence
from importlib.util import find_spec
from io import TextIOWrapper
from pathlib import Path

from framework.errors import ConfigError, UserError
from framework.storage.closed_pipes import survive_closed_pipes
from framework.storage.log_messages import PlainLogRecord
from framework.storage.threads import limit_spinning

START = """\
python -m framework experiment=pascal3d/scvae     train, test and report
python -m framework experiment=<name> debug=fast  the same, shortened
python -m framework -m experiment=<name> seed=0,1,2
                                                  a sweep and its table
python -m framework --help                        experiments, methods, data
python -m framework mode=plugins                  methods and their papers
python -m framework mode=new mode.plugin=density_head/my_head
                                                  start a method of your own
docs/start/by_task.md names the first command for your task and your own files;
docs/commands.md lists all commands.
"""
"""Text for a command without arguments."""
PAGES = {
    "hydra/launcher=": "docs/engines.md",
    "hydra/sweeper=": "docs/search.md",
    "resume=": "docs/how_to/resume.md",
    "budget.": "docs/how_to/budgets.md",
    "mode=render": "docs/how_to/render.md",
    "mode=export": "docs/export.md",
    "mode=new": "docs/how_to/add_a_plugin.md",
    "mode=check": "docs/how_to/add_a_plugin.md",
    "mode=sync": "docs/how_to/tracking.md",
    "mode=report": "docs/how_to/figures.md",
    "mode=work_precision": "docs/explanation/error_and_run_time.md",
    **dict.fromkeys(("logger=[", "logger=tensorboard", "logger=wandb", "logger."), "docs/how_to/tracking.md"),
    "mode=": "docs/commands.md",
    "data=tabular": "docs/tables.md",
    "data.": "docs/how_to/own_data.md",
    "-m": "docs/how_to/sweeps.md",
    "--multirun": "docs/how_to/sweeps.md",
}
"""Pages of the documentation that help after an error of a command, by the beginning of a word of this command.

If several pages fit a command, the first of them in this order is named.
"""
FIRST_PAGE = "docs/start/by_task.md"
"""Page that helps after an error of a command to which no page in `PAGES` belongs."""


def main() -> None:
    """Run the command line of `python -m framework`.

    The exit code is 0 for success, 1 for a failure, 2 for a command or config that is refused, 129 if the terminal was
    closed, 130 after an interruption (Ctrl-C), and 143 after SIGTERM.
    """
    limit_spinning()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # printing a table must not fail on a terminal without ±
            stream.reconfigure(errors="backslashreplace")
    survive_closed_pipes()
    logging.setLogRecordFactory(PlainLogRecord)
    # Hydra prints its own errors and exits unless told to raise them.
    full_error = os.environ.get("HYDRA_FULL_ERROR")
    os.environ["HYDRA_FULL_ERROR"] = "1"
    arguments = sys.argv[1:]
    try:
        _run()
    except UserError as error:
        _fail(str(error), 2 if isinstance(error, ConfigError) else 1, page_of(arguments))
    except KeyboardInterrupt:
        _fail("interrupted.", 130)
    except Exception as error:
        from framework.configuration.composition import describe_error
        from framework.storage.files import describe_unwritable

        refused = describe_unwritable(error)
        message = None if full_error == "1" else refused or describe_error(error)
        if message is None:
            raise
        _fail(message, 1 if refused else 2, "" if refused else page_of(arguments))


def _run() -> None:
    expected = Path(__file__).resolve().parent.parent / "plugins" / "__init__.py"
    spec = find_spec("plugins")
    if spec is None or not spec.origin or Path(spec.origin).resolve() != expected:
        raise ConfigError(
            f"The package `plugins` was found at {spec and spec.origin}, not at {expected}: a file or folder of "
            "that name hides it. Rename that file or folder, remove its parent folder from PYTHONPATH, or use "
            "`python -P -m framework`."
        )
    if not sys.argv[1:]:
        sys.stdout.write(f"{_version()}\n\n{START}")
        sys.exit(2)
    if sys.argv[1:] == ["--version"]:
        sys.stdout.write(f"{_version()}\n")
        return
    if sys.argv[1:] == ["mode=plugins"]:  # needs no config, so it makes no run folder
        from framework.modes.plugins import print_plugins

        print_plugins()
        return
    from framework.configuration.command_line import command_line
    from framework.configuration.composition import folder, help_text, plain, register
    from framework.storage.files import remove_empty_folders
    from framework.storage.working_directory import refuse_settings

    if {"--help", "-h"} & set(sys.argv[1:]):
        sys.stdout.write(help_text() + "\n")
        return
    refuse_settings(("numba", "matplotlib"))
    import hydra
    from hydra.core.hydra_config import HydraConfig
    from omegaconf import DictConfig

    sys.argv[1:] = command_line(sys.argv[1:])
    register()

    failures: list[BaseException] = []

    @hydra.main(version_base="1.3", config_path=str(folder()), config_name="config")
    def run(config: DictConfig) -> float | None:
        from framework import modes

        hydra_config = HydraConfig.get()
        run_folder = Path(hydra_config.runtime.output_dir)
        try:
            return modes.run(plain(config), run_folder, list(hydra_config.overrides.task))
        except UserError as error:
            remove_empty_folders(run_folder)
            # Hydra would print a long stack trace of its own around the sentence.
            failures.append(error)
            return None

    run()
    if failures:
        raise failures[0]


def _version() -> str:
    from framework import __version__

    return f"robust-visual-learning {__version__} (Python {sys.version.split()[0]})"


def page_of(arguments: Sequence[str]) -> str:
    """Return the address of the documentation page that helps after an error of a command with `arguments`."""
    words = [word.lstrip("+~") for word in arguments]
    return next(
        (page for start, page in PAGES.items() if any(word.startswith(start) for word in words)), FIRST_PAGE
    )


def _fail(message: str, code: int, page: str = "") -> None:
    sys.stderr.write(f"error: {message}\n")
    if page:
        sys.stderr.write(f"help:  {page}\n")
    sys.exit(code)
