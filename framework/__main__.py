"""Entry module of the command `python -m framework`, which starts the command line."""

import os
import sys


def forget_working_directory() -> None:
    """Remove the working directory, which `python -m` puts first, from `sys.path` of this process and of its children.

    The working directory may be an unpacked archive that contains a `yaml.py` or `hydra_plugins/`. If the working
    directory is the folder that contains the framework, it is kept.
    """
    framework_folder = os.path.realpath(os.path.join(os.path.dirname(__file__), os.pardir))  # noqa: PTH118, PTH120 - no import
    try:
        working_directory = os.path.realpath(os.getcwd())  # noqa: PTH109
    except OSError:  # the working directory was deleted
        return
    if sys.path and os.path.realpath(sys.path[0]) == working_directory != framework_folder:
        del sys.path[0]
        os.environ["PYTHONSAFEPATH"] = "1"


if __name__ == "__main__":
    forget_working_directory()

    from framework.app import main

    main()
