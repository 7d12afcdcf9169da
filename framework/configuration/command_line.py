"""Checks and translation of a command line before Hydra reads it."""

import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import NoReturn

import yaml
from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from framework.configuration.composition import folder, groups, in_quotes, options, register
from framework.configuration.foreign_configs import require_harmless
from framework.configuration.newest import LAST, newest_run
from framework.configuration.stored_keys import as_stored, names_run
from framework.errors import ConfigError, did_you_mean, escape_unprintable, nearest_name
from framework.tracking.stores import require_no_password


def command_line(arguments: list[str]) -> list[str]:
    """Return the arguments in the form that Hydra reads.

    Raises:
        ConfigError: An argument would run code or store a password, is an unknown flag, or names a missing run to
            resume.
    """
    _refuse_code_and_passwords(arguments)
    arguments = _put_flags_first(arguments)
    require_harmless(arguments, groups())
    arguments = _add_trainer_keys(_name_callbacks(_list_loggers(arguments)))
    arguments = _name_newest_run(_use_resumed_folder(as_stored(arguments)))
    return _sweep_single_values(_choose_preset(arguments))


def _add_trainer_keys(arguments: list[str]) -> list[str]:
    """Return the arguments with `++` before keys of Lightning's Trainer that no config of `trainer` holds.

    Hydra refuses a new key without a plus sign.
    """
    if not any(argument.startswith("trainer.") for argument in arguments):
        return arguments
    from framework.configuration.settings import TrainerSettings

    known = yaml.safe_load((folder() / "trainer/default.yaml").read_text(encoding="utf-8"))
    new = {f"trainer.{key}" for key in TrainerSettings.model_fields.keys() - known.keys()}
    return [
        f"++{argument}"
        if argument.partition("=")[0] in new or argument.startswith("trainer.callbacks.")
        else argument
        for argument in arguments
    ]


def _name_callbacks(arguments: list[str]) -> list[str]:
    """Replace `trainer.callbacks=[a,b]` by a mapping, so that `trainer.callbacks.a.key=value` can set a key of `a`.

    Raises:
        ConfigError: There is no such callback, or it cannot be chosen.
    """
    chosen = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key.lstrip("+") == "trainer.callbacks" and value.startswith("[") and value.count("[") == 1:
            from framework.configuration.settings import refuse_callback

            names = [name.strip() for name in value.strip("[]").split(",") if name.strip()]
            for name in names:
                try:
                    refuse_callback(name)
                except ValueError as error:
                    raise ConfigError(f"{argument}: {error}.") from None
            argument = f"{key}={{{','.join(f'{name}:{{}}' for name in names)}}}"
        chosen.append(argument)
    return chosen


def _list_loggers(arguments: list[str]) -> list[str]:
    """Replace `logger=[mlflow,csv]` by the store, `logger=mlflow`, and the further formats, `logger.copies=[csv]`.

    Raises:
        ConfigError: There is no such logger, or `none` stands beside another one.
    """
    chosen: list[str] = []
    for argument in arguments:
        key, _, value = argument.partition("=")
        if key != "logger" or not value.startswith("["):
            chosen.append(argument)
            continue
        names = [name.strip() for name in value.strip("[]").split(",") if name.strip()]
        known = options("logger")
        for name in names:
            if name not in known:
                raise ConfigError(
                    f"{argument}: there is no logger {name!r}.{did_you_mean(name, known)} The loggers are "
                    f"{', '.join(known)}."
                )
        if not names or ("none" in names and len(names) > 1):
            raise ConfigError(
                f"{argument}: give the names of one or more loggers, or logger=none. The loggers are "
                f"{', '.join(known)}."
            )
        copies = [name for name in names if name not in ("mlflow", "none")]
        chosen += [
            f"logger={'mlflow' if 'mlflow' in names else 'none'}",
            *([f"logger.copies=[{','.join(copies)}]"] if copies else []),
        ]
    return chosen


def _name_newest_run(arguments: list[str]) -> list[str]:
    """Replace `checkpoint=last` by the folder of the newest run, so that the stored config names a fixed run.

    Raises:
        CheckpointError: There is no run with a checkpoint.
    """
    if f"checkpoint={LAST}" not in arguments or Path(LAST).exists():
        return arguments
    run = newest_run(Path("outputs"))
    sys.stderr.write(f"checkpoint={LAST} is {escape_unprintable(str(run), allowed='')}\n")
    return [
        f"checkpoint={in_quotes(str(run))}" if argument == f"checkpoint={LAST}" else argument
        for argument in arguments
    ]


def _put_flags_first(arguments: list[str]) -> list[str]:
    """Return Hydra's flags, then all settings, because Hydra does not accept flags between two settings.

    Raises:
        ConfigError: A flag is unknown, or lacks its value.
    """
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise ConfigError(
            f"{message}. `--hydra-help` lists the flags. Write a setting as key=value, without dashes."
        )

    parser.error = refuse  # type: ignore[method-assign]
    known, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        raise ConfigError(_describe_unknown_flag(unknown[0], arguments))
    settings: list[str] = list(known.overrides)
    flags = []
    left = iter(settings)
    awaited = next(left, None)
    for argument in arguments:
        if argument == awaited:
            awaited = next(left, None)
        else:
            flags.append(argument)
    return flags + settings


def _describe_unknown_flag(flag: str, arguments: list[str]) -> str:
    """Return an error message that says how to write an unknown flag, such as `--epochs 5`, as a setting."""
    key, equals, value = flag.lstrip("-").partition("=")
    after = arguments[arguments.index(flag) + 1 :] if flag in arguments else []
    if not equals:
        value = after[0] if after and not after[0].startswith("-") and "=" not in after[0] else "..."
    key = key.replace("-", "_") if "." not in key else key
    return f"{flag} is an unknown flag. Write a setting without dashes: {_nearest_setting(key)}={value}"


def _nearest_setting(key: str) -> str:
    """Return the dotted key of the setting with the most similar name, or `key` itself if no name is similar."""
    from framework.configuration.settings import OptimizerSettings, Settings, TrainerSettings

    models = {"": Settings, "trainer.": TrainerSettings, "optimizer.": OptimizerSettings}
    known = {
        name: f"{before}{name}"
        for before, model in reversed(models.items())
        for name in model.model_fields
        if not name.startswith("min_")  # --epochs means the maximum
    }
    if key in groups() or "." in key:
        return key
    near = key if key in known else nearest_name(key, known)
    return known[near] if near else key


def _choose_preset(arguments: list[str]) -> list[str]:
    """Replace `preset=a` by `preset=a/<experiment>` or `preset=a/<data>` if a folder `a` contains such presets.

    Raises:
        ConfigError: No preset has that name or fits this data, or a sweep over experiments needs several presets.
    """
    arguments = [item.removeprefix("+") if item.startswith("+preset=") else item for item in arguments]
    preset_arguments = [item for item in arguments if item.startswith("preset=")]
    experiment_arguments = [item for item in arguments if item.startswith("experiment=")]
    other_arguments = [item for item in arguments if item not in (*preset_arguments, *experiment_arguments)]
    known = options("preset") if preset_arguments else []
    presets = []
    for name in _choices(preset_arguments[-1]) if preset_arguments else ():
        if not any(item.startswith(f"{name}/") for item in known):
            if name not in (*known, ""):
                folders = sorted({item.partition("/")[0] for item in known})
                raise ConfigError(
                    f"There is no config 'preset/{name}'.{did_you_mean(name, folders)} Available presets: "
                    f"{', '.join(folders)}."
                )
            presets.append(name)
            continue
        experiments = _choices(experiment_arguments[-1]) if experiment_arguments else [""]
        chosen = {_preset(name, known, other_arguments, experiment) for experiment in experiments}
        if len(chosen) > 1:
            raise ConfigError(
                f"preset={name} means several presets for these experiments: {', '.join(sorted(chosen))}. Sweep only "
                "over experiments that use the same preset."
            )
        presets += chosen
    return [f"preset={','.join(presets)}" if item in preset_arguments else item for item in arguments]


def _choices(argument: str) -> list[str]:
    """Return the names that an argument chooses for a group: one, or several in a sweep."""
    with suppress(HydraException):
        override = OverridesParser.create().parse_override(argument)
        if override.is_sweep_override():
            return [str(value) for value in override.sweep_string_iterator()]
    return [argument.partition("=")[2]]


def _preset(name: str, options: list[str], arguments: list[str], experiment: str) -> str:
    """Return the preset in the folder `name` for the experiment, or for the data that the other arguments choose."""
    data_arguments = [item for item in arguments if item.startswith("data=")]
    register()
    ready = GlobalHydra.instance().is_initialized()
    with nullcontext() if ready else initialize_config_dir(str(folder()), version_base="1.3"):
        composed = compose(
            "config",
            [f"experiment={experiment}"] * bool(experiment) + data_arguments,
            return_hydra_config=True,
        )
    groups = composed.hydra.runtime.choices
    for item in (f"{name}/{experiment}", f"{name}/{groups['data']}"):
        if item in options:
            return item
    available = ", ".join(sorted({item.split("/")[1] for item in options if item.startswith(f"{name}/")}))
    raise ConfigError(
        f"preset={name} has no setting for data={groups['data']}, only for {available}. Leave the preset out, or "
        "choose an experiment on one of these."
    )


def _use_resumed_folder(arguments: list[str]) -> list[str]:
    """Set Hydra's run folder to the folder of `resume=<run folder>`, so that Hydra creates no new one."""
    for index, argument in enumerate(arguments):
        key, _, value = argument.partition("=")
        if key == "resume" and names_run(value):
            path = Path(value).expanduser()
            if not path.exists() and value[0] in "'\"":
                with suppress(HydraException):
                    path = Path(str(OverridesParser.create().parse_override(argument).value())).expanduser()
            if not (path / "config.yaml").is_file():
                raise ConfigError(
                    f"resume={value}: {path / 'config.yaml'} does not exist. Give the folder of a run, "
                    "as printed at its start (outputs/<experiment>/<time>)."
                )
            quoted_path = in_quotes(str(path))
            return [
                *arguments[:index],
                f"resume={quoted_path}",
                *arguments[index + 1 :],
                f"hydra.run.dir={quoted_path}",
            ]
    return arguments


def _refuse_code_and_passwords(arguments: list[str]) -> None:
    """Refuse arguments that would run code or store a password, before Hydra reads them.

    Hydra passes its logging configs to logging.config.dictConfig, which calls the functions that the configs name.
    Hydra's option --experimental-rerun unpickles a file.

    Raises:
        ConfigError: An argument chooses or changes a logging config, adds configs that are not checked, names a file to
            unpickle, or contains a password.
    """
    for argument in arguments:
        flag = argument.partition("=")[0]
        if flag in ("--experiment", "--exp"):
            raise ConfigError(_describe_unknown_flag(argument, arguments))
        # argparse accepts abbreviations
        if flag.startswith("--e") and "--experimental-rerun".startswith(flag):
            raise ConfigError(
                f"{argument} is refused, because Hydra unpickles that file, and unpickling can run code. Use "
                "resume=<folder>, or repeat the command in the run's overrides.yaml."
            )
        if argument.lstrip("+").startswith("logger.uri="):
            require_no_password(argument.partition("=")[2].strip("'\""))
        key = argument.lstrip("+~").partition("=")[0]
        if key == "hydra.searchpath":
            raise ConfigError(
                f"{argument} is refused, because the configs of that folder are not checked, and could run code. Use "
                "--config-dir=<folder> instead."
            )
        if key.replace(".", "/").startswith(("hydra/job_logging", "hydra/hydra_logging", "hydra/callbacks")):
            raise ConfigError(
                f"{argument} is refused, because Hydra's logging and callback configs can run code. "
                "Set the level of the log with hydra.verbose=true instead."
            )


def _sweep_single_values(arguments: list[str]) -> list[str]:
    """Replace single values by sweeps over one value, if the command is a sweep over experiments.

    Hydra first composes the config from the arguments that are not swept. With `experiment=a,b`, an argument
    `data.x=1` would be applied to a config in which no data is chosen yet.
    """
    if not {"-m", "--multirun"} & set(arguments):
        return arguments
    overrides = [
        argument for argument in arguments if "=" in argument and not argument.startswith(("-", "~"))
    ]
    try:
        parsed = dict(zip(overrides, OverridesParser.create().parse_overrides(overrides), strict=True))
    except HydraException:
        return arguments  # Hydra itself reports the error
    if not any(
        override.key_or_group == "experiment" and override.is_sweep_override() for override in parsed.values()
    ):
        return arguments

    def as_sweep(argument: str) -> str:
        override = parsed.get(argument)
        if (
            override is None
            or override.is_sweep_override()
            or (override.key_or_group or "").startswith("hydra")
        ):
            return argument
        key, _, value = argument.partition("=")
        return f"{key}=choice({value})" if value else argument

    return [as_sweep(argument) for argument in arguments]
