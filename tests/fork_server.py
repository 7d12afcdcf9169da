"""Runs `python -m framework` in forks of one process that has imported what runs import, which takes 5 s each time.

Each line of standard input is a command as JSON: its arguments, environment, working directory, folders of packages and
the file its output goes to. The answer to each is its exit code, or minus the signal that killed it. A fork owns all
that a process of its own would own; tests of what a command imports start a fresh one instead.
"""

import gc
import json
import os
import runpy
import signal
import sys
from multiprocessing import get_context
from typing import Any

import hydra.main  # noqa: F401
import matplotlib.backends.backend_agg  # noqa: F401
import pytorch_lightning  # noqa: F401

import framework.app
import framework.configuration.command_line
import framework.modes.predict
import framework.modes.train
import framework.reports.prediction_pictures
import framework.reports.training_curve  # noqa: F401


def run(
    arguments: list[str], environment: dict[str, str], folder: str, packages: list[str], output: str
) -> None:
    """Run the command, and end this process with its exit code."""
    signal.signal(signal.SIGHUP, signal.SIG_DFL)  # tests may run under nohup
    os.dup2(os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), 1)
    os.dup2(1, 2)
    os.chdir(folder)
    os.environ.clear()
    os.environ.update(environment)
    sys.path[:1] = [folder, *packages]
    sys.argv[1:] = arguments
    runpy.run_module("framework", run_name="__main__", alter_sys=True)


gc.freeze()  # so that collecting a fork's garbage copies none of these pages
for line in sys.stdin:
    given: dict[str, Any] = json.loads(line)
    fork = get_context("fork").Process(target=run, kwargs=given)
    fork.start()
    fork.join()
    print(fork.exitcode, flush=True)  # noqa: T201
