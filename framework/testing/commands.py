"""Commands of the framework in a new process, for tests of what a user does one after another."""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

SCRIPT = """
import json
import sys
from framework.app import main
for line in json.load(sys.stdin):
    sys.argv = ["framework", *line, "logger=none", "threads=1"]
    main()
"""


def run_commands(folder: Path, *commands: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run commands one after another in one process, in a folder and with a cache of its own; a failure ends them.

    Args:
        folder: working directory; its subfolder `cache` is the framework's cache.
        commands: overrides of each command, without the name of the program.
    """
    return subprocess.run(
        [sys.executable, "-c", SCRIPT],
        input=json.dumps(commands),
        cwd=folder,
        env={**os.environ, "FRAMEWORK_CACHE": str(folder / "cache")},
        capture_output=True,
        text=True,
        timeout=300,
    )
