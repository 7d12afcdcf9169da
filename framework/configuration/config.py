"""The config of a command: as it was composed, as the framework checked it, and the run folder it is for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ConfigDict

from framework.configuration.modes import is_below, key_of
from framework.configuration.schema import check
from framework.configuration.settings import Settings, settings


class Options(BaseModel):
    """What a mode can be told; each mode derives its own, with types and ranges."""

    model_config = ConfigDict(extra="forbid")

    name: str


Chosen = TypeVar("Chosen", bound=Options)


@dataclass(frozen=True)
class Config:
    """Everything a mode is given.

    Attributes:
        values: plain, as composed: what a run folder keeps, and what a resumed run is compared with.
        settings: the core's own part, checked.
        folder: of the run.
        overrides: what the command line changed.
        trained_on: the data set of the stored model that the command is about; empty where there is none.
    """

    values: Mapping[str, Any]
    settings: Settings
    folder: Path
    overrides: Sequence[str]
    trained_on: str = ""

    @classmethod
    def of(cls, values: Mapping[str, Any], folder: Path, overrides: Sequence[str]) -> "Config":
        """Check the core's part of composed values.

        Raises:
            ConfigError: an unknown key, or a value out of range.
        """
        return cls(values, settings(values), folder, overrides)

    @cached_property
    def parts(self) -> dict[str, Any]:
        """Every plugin with every parameter, checked once.

        Raises:
            ConfigError: a part is missing, or a plugin's name, key or value is wrong.
        """
        from framework.configuration.assembly import resolve_all  # torch, which not every mode needs

        return resolve_all(self.values)

    @property
    def mode(self) -> str:
        return self.values["mode"]["name"]

    def options(self, kind: type[Chosen]) -> Chosen:
        """What the mode is told.

        Raises:
            ConfigError: an unknown key, or a value out of range.
        """
        return kind.model_validate(check(kind, self.values["mode"], "mode"))

    def given(self, key: str) -> str | None:
        """What the command line says of a key, or of one below it; None where it says nothing."""
        found = (item for item in self.overrides if is_below(key_of(item).removeprefix("stored."), (key,)))
        return next(found, None)
