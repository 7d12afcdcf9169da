"""Config of a command: its checked settings and chosen plugins, and the folder of its run."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import BaseModel, ConfigDict

from framework.configuration.modes import is_below, key_of
from framework.configuration.schema import check
from framework.configuration.settings import Settings

if TYPE_CHECKING:
    from framework.configuration.assembly import Assembly


class Options(BaseModel):
    """Base of the options of a mode; each mode derives its own class with types and ranges."""

    model_config = ConfigDict(extra="forbid")

    name: str


Chosen = TypeVar("Chosen", bound=Options)


@dataclass(frozen=True)
class Config:
    """Config of a command, as a mode receives it.

    Attributes:
        settings: Checked settings and chosen plugins. The run folder stores them, and a run is resumed only if they
            agree with the stored ones.
        folder: Folder of the run.
        overrides: Overrides on the command line.
        trained_on: Name of the data set on which the stored model of the command was trained; "" without such a model.
    """

    settings: Settings
    folder: Path
    overrides: Sequence[str]
    trained_on: str = ""

    @classmethod
    def of(cls, values: Mapping[str, Any], folder: Path, overrides: Sequence[str]) -> "Config":
        """Return the config of a command after checking the settings in `values` that belong to no plugin.

        Raises:
            ConfigError: A key is unknown, a value is out of range, or a package of a logger is missing.
        """
        settings = Settings.of(values)
        if settings.logger.copies:
            from framework.tracking.copies import require_packages

            require_packages(settings.logger.copies)
        return cls(settings, folder, overrides)

    @cached_property
    def assembly(self) -> "Assembly":
        """Return the plugins of a training, which are checked and built at the first access.

        Raises:
            ConfigError: A part is missing, or a plugin's name, key or value is wrong.
        """
        from framework.configuration.assembly import assemble  # imports torch, which not every mode needs

        return assemble(self.settings)

    @property
    def mode(self) -> str:
        """Return the name of the mode."""
        return self.settings.mode["name"]

    def options(self, kind: type[Chosen]) -> Chosen:
        """Return the checked options of the mode as an object of class `kind`.

        Raises:
            ConfigError: A key is unknown, or a value is out of range.
        """
        return kind.model_validate(check(kind, self.settings.mode, "mode"))

    def first_override(self, key: str) -> str | None:
        """Return the first override on the command line that sets `key` or a key below it; None if there is none."""
        matches = (item for item in self.overrides if is_below(key_of(item).removeprefix("stored."), (key,)))
        return next(matches, None)
