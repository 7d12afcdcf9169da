"""Check of all jobs of a sweep before the first one runs, in a separate process that may import torch."""

import json
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from framework.configuration.config import Config
from framework.configuration.modes import require_read
from framework.errors import ConfigError, UserError
from framework.tracking.signals import end_with_parent

COMMAND: Sequence[str] = (sys.executable, "-P", "-m", "framework.sweeps.rehearsal")


def refuse_mistakes(jobs: Sequence[tuple[Sequence[str], Mapping[str, Any]]]) -> None:
    """Refuse a sweep if a training job has a wrong config, or its data set cannot read the user's files.

    The files are checked by `Data.check_files`.

    Args:
        jobs: Overrides and composed config, as plain values, of each job.

    Raises:
        ConfigError: A job has a mistake; the message is the one that the first such job would print.
    """
    training = [
        (list(overrides), values) for overrides, values in jobs if values.get("mode") == {"name": "train"}
    ]
    for overrides, values in training:
        try:
            Config.of(values, Path(), overrides)  # this check needs no separate process
            require_read("train", overrides)
        except UserError as error:
            raise ConfigError(_name_job(overrides, str(error))) from error
    if not training:
        return
    result = subprocess.run(
        COMMAND,
        input=json.dumps(training),
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=end_with_parent(signal.SIGKILL),
    )
    if result.returncode == 2:
        raise ConfigError(result.stdout)
    # any other failure is reported by the jobs themselves


def _name_job(overrides: Sequence[str], message: str) -> str:
    return f"{message} This is the error of the job {' '.join(overrides)}. No job of the sweep was run."


def main() -> None:
    """Read jobs from standard input, and check them; print the first mistake and exit with code 2."""
    checked_data: set[str] = set()
    for overrides, values in json.load(sys.stdin):
        try:
            assembly = Config.of(values, Path(), overrides).assembly
            if repr(assembly.parts["data"]) not in checked_data:
                checked_data.add(repr(assembly.parts["data"]))
                assembly.data.check_files()
        except UserError as error:
            sys.stdout.write(_name_job(overrides, str(error)))
            sys.exit(2)


if __name__ == "__main__":
    main()
