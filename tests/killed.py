"""`python -m framework`, of which one rank ends at a chosen moment: `python -m tests.killed <arguments>`.

KILL in the environment is `<rank>|<moment>|<how>`, with how the name of a signal or "error"; KILLED is a file that is
there once that has happened.
"""

import os
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

PLACES = {
    "start": None,
    "before the first step": ("framework.training.module", "Training", "configure_optimizers", 1),
    "collective": ("framework.training.module", None, "rank_share", 5),
    "between epochs": ("framework.training.module", "StopAtBatch", "on_train_epoch_end", 1),
    "in a checkpoint": ("torch", None, "save", 5),
    "testing": ("framework.modes.train", None, "report_test", 1),
    "fitted": ("framework.runs.fit", None, "mean_loss", 1),
    "logged": ("framework.modes.train", None, "calibrate", 1),
    "tested": ("framework.modes.train", None, "remove_resume_files", 1),
}
"""Module, class and function at whose call the rank ends, and the number of that call, by moment."""


def end(how: str) -> None:
    """End this process by an error or a signal."""
    Path(os.environ["KILLED"]).touch()
    if how == "error":
        raise ValueError("this rank is bad")
    os.kill(os.getpid(), signal.Signals[how])


def plant() -> None:
    """Let this process end at the moment that KILL names, if this process is that rank."""
    rank, moment, how = os.environ["KILL"].split("|")
    own = [os.environ[name] for name in ("RANK", "SLURM_PROCID", "LOCAL_RANK") if name in os.environ]
    if (own or ["0"])[0] != rank:
        return
    place = PLACES[moment]
    if place is None:
        end(how)
        return
    from importlib import import_module

    module, owner, name, count = place
    holder: Any = import_module(module)
    holder = getattr(holder, owner) if owner else holder
    original: Callable[..., Any] = getattr(holder, name)
    calls = 0

    def called(*given: Any, **named: Any) -> Any:
        nonlocal calls
        calls += 1
        if calls == count:
            end(how)
        return original(*given, **named)

    setattr(holder, name, called)


if __name__ == "__main__":
    sys.argv[0] = "framework"
    if os.environ.get("KILL"):
        plant()
    from framework.app import main

    main()
