"""Settings files of other packages in the working directory, which may be an unpacked archive of another person."""

import os
from collections.abc import Collection

from framework.errors import ConfigError

SETTINGS = {
    "numba": (".numba_config.yaml",),
    "matplotlib": ("matplotlibrc",),
    "wandb": ("wandb/settings", ".wandb/settings", "config-defaults.yaml"),
}
"""Files in the working directory that a package reads, by the name of the package.

They steer what runs and what is contacted: numba loads compiled code from the folder that its file names, Matplotlib
starts LaTeX with commands from its file, and wandb sends its key to the server that its file names.
"""
ELSEWHERE = {
    "numba": "the environment variables NUMBA_…",
    "matplotlib": "the file ~/.config/matplotlib/matplotlibrc",
    "wandb": "the environment variables WANDB_… or the file ~/.config/wandb/settings",
}
"""Places in which the user's own settings of a package are read, by the name of the package."""


def refuse_settings(packages: Collection[str]) -> None:
    """Refuse settings files of these packages in the working directory, before the packages are imported.

    Raises:
        ConfigError: One of the files in `SETTINGS` exists, whatever kind of file it is.
    """
    for package in packages:
        for name in SETTINGS[package]:
            if os.path.lexists(name):
                raise ConfigError(
                    f"The working directory contains {name}, from which the package {package} reads settings. The "
                    "directory may come from another person, so such a file is not used. Remove it, or run the "
                    f"command in another directory; if the settings are your own, move them to {ELSEWHERE[package]}."
                )
