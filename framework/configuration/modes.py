"""Keys of a config that each mode reads; a command that sets other keys is refused."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from framework.configuration.registry import GROUPS, MODEL
from framework.errors import ConfigError, shorten

EVERYWHERE = ("mode", "seed", "threads", "logger", "hydra")
"""Keys that every command accepts, because scripts pass them to all their commands."""
BUNDLES = ("experiment", "preset", "debug")
"""Groups whose configs set keys of several other groups; a mode uses only the keys that it reads."""
_RUN = ("resume", "experiment_name")
_TEST = ("batch_size", "workers", "samples", "pictures")
_STORED = (*_RUN, *_TEST, *BUNDLES, "trainer.accelerator", "data", "metric")


@dataclass(frozen=True)
class Mode:
    """Keys that a mode reads.

    Attributes:
        reads: Keys that the mode reads, including all keys below them.
        stored: Groups of the stored model's config whose keys a command may repeat, such as `data.root=...`.
    """

    reads: tuple[str, ...] = ()
    stored: tuple[str, ...] = ()


_TRAIN = (
    *(*_RUN, *_TEST, *BUNDLES, "checkpoint", "data", "outliers", "encoder", "density_head"),
    *("uncertainty", "objective", "metric", "optimizer", "trainer"),
)

MODES: Mapping[str, Mode] = {
    "train": Mode(_TRAIN),
    "test": Mode((*_STORED, "checkpoint", "outliers"), ("data", "outliers", "metric", *MODEL)),
    "calibrate": Mode(
        (*_STORED, "checkpoint", "outliers", "uncertainty"), ("data", "outliers", "metric", *MODEL)
    ),
    "combine": Mode((*_STORED, "outliers", "uncertainty"), ("data", "outliers", "metric", *MODEL)),
    "predict": Mode(
        (*_RUN, *BUNDLES, "workers", "samples", "checkpoint", "data", "budget"), ("data", *MODEL)
    ),
    "encode": Mode((*_RUN, *BUNDLES, "batch_size", "workers", "data", "encoder")),
    "export": Mode((*BUNDLES, "checkpoint", "budget"), ("data", *MODEL)),
    "work_precision": Mode((*_STORED, "checkpoint"), ("data", "metric", *MODEL)),
    "render": Mode((*_TRAIN, "renderer")),
    "check": Mode((*BUNDLES, *GROUPS)),
    "plugins": Mode(),
    "new": Mode(),
    "report": Mode(),
    "sync": Mode(),
}
"""Keys that each mode reads, by the name of the mode."""

UNUSED_BY_TRAINING = {
    "limit_test_batches": "the test always covers its whole split",
    "limit_predict_batches": "training predicts nothing; mode=predict does",
    "inference_mode": "only Lightning's own tests read it, and the framework does not use them",
    "log_every_n_steps": "metrics go to the run's journal; trainer.log_every_steps says how often",
    "enable_autolog_hparams": "parameters go to the run's store, which logger chooses",
    "model_registry": "the model goes to the run's store, which logger chooses",
}
"""Keys of `trainer` that Lightning accepts but that have no effect on a training here, each with the reason."""


@dataclass(frozen=True)
class _Condition:
    """Condition under which a run reads a setting.

    Attributes:
        key: Dotted key of the setting.
        holds: Function that takes a config and returns whether it meets the condition.
        why: Reason why the setting is not read if the condition is not met.
    """

    key: str
    holds: Callable[[Mapping[str, Any]], bool]
    why: str


def _setting(values: Mapping[str, Any], group: str, key: str) -> Any:
    return (values.get(group) or {}).get(key)


def _has_schedule(*names: str) -> Callable[[Mapping[str, Any]], bool]:
    return lambda values: _setting(values, "optimizer", "schedule") in names


def _has_store(values: Mapping[str, Any]) -> bool:
    return _setting(values, "logger", "name") != "none"


def _chooses_data(values: Mapping[str, Any]) -> bool:
    mode = MODES.get(str(_setting(values, "mode", "name")), Mode())
    return not mode.stored or bool(values.get("data"))


_CONDITIONS = (
    _Condition(
        "optimizer.factor", _has_schedule("step", "plateau"), "only the schedules step and plateau read it"
    ),
    _Condition("optimizer.patience", _has_schedule("plateau"), "only the schedule plateau reads it"),
    _Condition(
        "trainer.gradient_clip_algorithm",
        lambda values: bool(_setting(values, "trainer", "gradient_clip_val")),
        "trainer.gradient_clip_val=null clips nothing",
    ),
    *(_Condition(f"logger.{key}", _has_store, "logger=none has no store") for key in ("uri", "experiment")),
    *(_Condition(f"trainer.{key}", lambda values: False, why) for key, why in UNUSED_BY_TRAINING.items()),
    *(
        _Condition(
            key,
            _chooses_data,
            "the command uses the stored model and its stored data, and this setting changes only parts that a command "
            "chooses",
        )
        for key in ("preset", "debug")
    ),
)
"""Conditions on the composed config that this module checks.

Settings whose lack of effect cannot be seen from the config are refused later, by `runs.job.refuse_idle`.
"""


def require_read(mode: str, overrides: Sequence[str]) -> None:
    """Refuse settings of a command that its mode never reads.

    Args:
        mode: One of MODES.
        overrides: Overrides on the command line.

    Raises:
        ConfigError: The mode does not read a setting; the message names the first one and the modes that read it.
    """
    for override in overrides:
        key = key_of(override)
        name = key.removeprefix("stored.")
        read = MODES[mode].stored if key != name else (*MODES[mode].reads, *EVERYWHERE)
        if not is_below(name, read):
            root = name.partition(".")[0]
            root = shorten(name if any(readable.startswith(f"{root}.") for readable in read) else root)
            raise ConfigError(
                f"{_as_typed(override)}: mode={mode} reads no {root}{_readers(name)}. Leave this setting out."
            )


def idle_sentences(values: Mapping[str, Any], overrides: Sequence[str]) -> Iterator[str]:
    """Yield a sentence for each setting of a command that has no effect because of the command's other settings.

    Args:
        values: Composed config.
        overrides: Overrides on the command line.
    """
    for override in overrides:
        for condition in _CONDITIONS:
            if key_of(override) == condition.key and not condition.holds(values):
                yield idle_sentence(override, condition.why)


def idle_sentence(override: str, why: str) -> str:
    """Return the sentence that says that a setting has no effect, and why."""
    return f"{_as_typed(override)} has no effect: {why}. Leave this setting out."


def key_of(override: str) -> str:
    """Return the dotted key that an override sets, such as `outliers` for `data@outliers=...`."""
    group, _, package = override.lstrip("+~").partition("=")[0].partition("@")
    return (package or group).replace("/", ".")


def is_below(key: str, roots: Sequence[str]) -> bool:
    """Return whether a dotted key is one of `roots` or lies below one."""
    return any(key == root or key.startswith(f"{root}.") for root in roots)


def _as_typed(override: str) -> str:
    """Return an override as the user typed it, without the prefix `stored` that the framework adds."""
    return shorten(override.removeprefix("+stored."))


def _readers(key: str) -> str:
    """Return the end of a sentence that lists the modes that read a key; an empty text if no mode reads it."""
    names = [name for name, mode in MODES.items() if is_below(key, mode.reads)]
    return f"; {', '.join(names)} {'do' if len(names) > 1 else 'does'}" if names else ""
