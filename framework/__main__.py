"""`python -m framework`."""

import os
import sys


def forget_working_directory() -> None:
    """Take away the entry of `sys.path` that `python -m` puts first, in the processes that this one starts as well.

    The working directory may be an unpacked archive that brings a `yaml.py` or `hydra_plugins/`. It stays where the
    framework itself lives there.
    """
    own = os.path.realpath(os.path.join(os.path.dirname(__file__), os.pardir))  # noqa: PTH118, PTH120 - no import
    try:
        here = os.path.realpath(os.getcwd())  # noqa: PTH109
    except OSError:  # it was deleted
        return
    if sys.path and os.path.realpath(sys.path[0]) == here != own:
        del sys.path[0]
        os.environ["PYTHONSAFEPATH"] = "1"


if __name__ == "__main__":
    forget_working_directory()

    from framework.app import main

    main()
