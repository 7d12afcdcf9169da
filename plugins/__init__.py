"""Plugins, one self-contained folder for each; the core finds them by entry points and imports none by name."""

import os
import sys

# `python -m plugins.…` runs this module first. The working directory may hold other modules of the same names as ours;
# it is removed from the path, as in `framework.__main__`.
if sys.argv[:1] == ["-m"] and any("plugins" in argument for argument in sys.orig_argv):
    _own = os.path.realpath(os.path.join(os.path.dirname(__file__), os.pardir))  # noqa: PTH118, PTH120 - no import
    _first = os.path.realpath(sys.path[0]) if sys.path else _own
    if _first != _own and os.path.isdir(_first) and os.path.samefile(_first, os.curdir):  # noqa: PTH112, PTH121
        del sys.path[0]
        os.environ["PYTHONSAFEPATH"] = "1"
