"""The core's own part of the config: types, ranges and defaults; plugins check theirs by their constructors."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from framework.configuration.registry import GROUPS
from framework.configuration.schema import check, forbid_targets
from framework.errors import ConfigError, did_you_mean

Positive = Annotated[int, Field(gt=0)]
NotNegative = Annotated[int, Field(ge=0)]


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", protected_namespaces=())


class OptimizerSettings(_Strict):
    """An optimiser of torch.optim by its lower-case name, and a schedule per step."""

    name: Literal["adam", "adamw", "sgd", "nadam", "radam"] = "adamw"
    learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-3
    momentum: Annotated[float, Field(ge=0, lt=1)] | None = None
    """Of sgd alone, and 0 where nothing is said; the others have moments of their own."""
    weight_decay: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.0
    schedule: Literal["constant", "cosine"] = "constant"
    warmup_steps: NotNegative = 0

    @model_validator(mode="after")
    def _momentum_is_sgds(self) -> "OptimizerSettings":
        if self.momentum is not None and self.name != "sgd":
            raise ValueError(
                f"momentum is a setting of sgd, {self.name} has none. Leave it out, or choose sgd"
            )
        return self


class LoggerSettings(_Strict):
    """Where metrics go beside the local journal."""

    name: Literal["mlflow", "none"] = "mlflow"
    uri: str | None = None
    experiment: str | None = None


class Settings(_Strict):
    """Everything of a composed config that is not a plugin's."""

    seed: Annotated[int, Field(ge=0, lt=2**31)] = 0
    threads: Positive | None = None
    batch_size: Positive = 64
    workers: NotNegative = 0
    samples: Positive = 1000
    pictures: bool = True
    checkpoint: str | None = None
    resume: str | None = "auto"
    experiment_name: str | None = None
    optimizer: OptimizerSettings = OptimizerSettings()
    logger: LoggerSettings = LoggerSettings()
    trainer: dict[str, Any] = {}
    mode: dict[str, Any] = {}


def store_experiment(config: Mapping[str, Any]) -> str:
    """The tracking store's experiment for a run: "data" for `experiment=data/method`, unless the logger names one.

    One for all methods on the same data, so that a sweep over methods stands under its parent and compares.
    """
    logger = config.get("logger") or {}
    name = config.get("experiment_name")
    return str(logger.get("experiment") or (name.partition("/")[0] if name else "default"))


TRAINER_OURS = {"patience", "checkpoint_every_steps", "log_every_steps", "keep"}
"""Keys of `trainer` that the framework reads; the others go to pytorch_lightning.Trainer."""


def settings(config: Mapping[str, Any]) -> Settings:
    """The checked core settings of a composed config.

    Raises:
        ConfigError: `_target_` anywhere, an unknown key, or a value out of range.
    """
    forbid_targets(config)
    own = {key: value for key, value in config.items() if key not in (*GROUPS, "outliers")}
    for key in ("optimizer", "logger"):
        model = {"optimizer": OptimizerSettings, "logger": LoggerSettings}[key]
        if isinstance(own.get(key), Mapping):
            own[key] = check(model, own[key], key)
    values = check(Settings, own, "")
    checked = Settings.model_validate(values)
    _check_trainer(checked.trainer)
    every, epochs = checked.trainer.get("check_val_every_n_epoch"), checked.trainer.get("max_epochs")
    if every and epochs:  # a shorter run is validated at its end, too
        checked.trainer["check_val_every_n_epoch"] = min(every, epochs)
    return checked


def _check_trainer(trainer: Mapping[str, Any]) -> None:
    numbers = {
        "max_epochs": (int, 1),
        "check_val_every_n_epoch": (int, 1),
        "patience": (int, 1),
        "checkpoint_every_steps": (int, 1),
        "log_every_steps": (int, 1),
        "num_nodes": (int, 1),
        "gradient_clip_val": ((int, float), 0),
    }
    for key, (kind, least) in numbers.items():
        value = trainer.get(key)
        if value is not None and (
            isinstance(value, bool) or not isinstance(value, kind) or not value >= least
        ):
            raise ConfigError(f"trainer.{key} = {value!r}: wanted a number of at least {least}, or null.")
    if trainer.get("keep", "best") not in ("best", "last"):
        raise ConfigError(
            f"trainer.keep = {trainer['keep']!r}: wanted `best` (the weights of the lowest validation loss) or `last`."
        )


def check_trainer_keys(trainer: Mapping[str, Any], known: set[str]) -> None:
    """Refuse a key that neither the framework nor Lightning's Trainer knows.

    Raises:
        ConfigError: with the nearest known key.
    """
    for key in trainer:
        if key not in known | TRAINER_OURS:
            raise ConfigError(
                f"trainer.{key}: unknown key.{did_you_mean(key, known | TRAINER_OURS)} "
                "Known: the arguments of pytorch_lightning.Trainer, "
                f"and {', '.join(sorted(TRAINER_OURS))}."
            )
