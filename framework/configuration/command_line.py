"""Checks and translation of a command line before Hydra reads it."""

import sys
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import NoReturn

from hydra import compose, initialize_config_dir
from hydra._internal.utils import get_args_parser
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException

from framework.configuration.composition import folder, groups, in_quotes, options, register
from framework.configuration.foreign_configs import require_harmless
from framework.configuration.newest import LAST, newest_run
from framework.configuration.stored_keys import as_stored
from framework.errors import ConfigError, did_you_mean, escape_unprintable, nearest_name
from framework.tracking.stores import require_no_password


def command_line(arguments: list[str]) -> list[str]:
    """Return the arguments in the form that Hydra reads.

    Raises:
        ConfigError: An argument would run code or store a password, is an unknown flag, or names a missing run to
            resume.
    """
    _refuse_code_and_passwords(arguments)
    arguments = _flags_first(arguments)
    require_harmless(arguments, groups())
    arguments = _newest_checkpoint(_in_resumed_folder(as_stored(arguments)))
    return _swept_with_experiment(_preset_for_the_data(arguments))


def _newest_checkpoint(arguments: list[str]) -> list[str]:
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


def _flags_first(arguments: list[str]) -> list[str]:
    """Return Hydra's flags followed by the settings, because Hydra reads settings only if they follow each other.

    Raises:
        ConfigError: A flag is unknown, or lacks its value.
    """
    parser = get_args_parser()

    def refuse(message: str) -> NoReturn:
        raise ConfigError(f"{message}. `--hydra-help` lists the flags; settings are written as key=value.")

    parser.error = refuse  # type: ignore[method-assign]
    known, unknown = parser.parse_known_intermixed_args(arguments)
    if unknown:
        raise ConfigError(_no_flag(unknown[0], arguments))
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


def _no_flag(flag: str, arguments: list[str]) -> str:
    """Return an error message that says how to write an unknown flag, such as `--epochs 5`, as a setting."""
    key, equals, value = flag.lstrip("-").partition("=")
    after = arguments[arguments.index(flag) + 1 :] if flag in arguments else []
    if not equals:
        value = after[0] if after and not after[0].startswith("-") and "=" not in after[0] else "..."
    key = key.replace("-", "_") if "." not in key else key
    return f"{flag}: no such flag. Settings are written without dashes: {_setting_like(key)}={value}"


def _setting_like(key: str) -> str:
    """Return the dotted key of the setting with the most similar name; the given key if there is none."""
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


def _preset_for_the_data(arguments: list[str]) -> list[str]:
    """Replace `preset=a` by `preset=a/<experiment>` or `preset=a/<data>` if a folder `a` holds such presets.

    Raises:
        ConfigError: There is no preset of that name or for this data, or a sweep over experiments needs several.
    """
    arguments = [one.removeprefix("+") if one.startswith("+preset=") else one for one in arguments]
    given = [one for one in arguments if one.startswith("preset=")]
    swept = [one for one in arguments if one.startswith("experiment=")]
    others = [one for one in arguments if one not in (*given, *swept)]
    known = options("preset") if given else []
    presets = []
    for name in _choices(given[-1]) if given else ():
        if not any(one.startswith(f"{name}/") for one in known):
            if name not in (*known, ""):
                folders = sorted({one.partition("/")[0] for one in known})
                raise ConfigError(f"No configuration 'preset/{name}'.{did_you_mean(name, folders)}")
            presets.append(name)
            continue
        experiments = _choices(swept[-1]) if swept else [""]
        chosen = {_preset(name, known, others, experiment) for experiment in experiments}
        if len(chosen) > 1:
            raise ConfigError(
                f"preset={name} is another for each of these experiments: {', '.join(sorted(chosen))}. Sweep over "
                "those of one alone."
            )
        presets += chosen
    return [f"preset={','.join(presets)}" if one in given else one for one in arguments]


def _choices(argument: str) -> list[str]:
    """Return the names that an argument chooses for a group: one, or several in a sweep."""
    with suppress(HydraException):
        one = OverridesParser.create().parse_override(argument)
        if one.is_sweep_override():
            return [str(value) for value in one.sweep_string_iterator()]
    return [argument.partition("=")[2]]


def _preset(name: str, options: list[str], arguments: list[str], experiment: str) -> str:
    """Return the preset of the folder `name` for the experiment or the data that the other arguments choose."""
    own = [one for one in arguments if one.startswith("data=")]
    register()
    ready = GlobalHydra.instance().is_initialized()
    with nullcontext() if ready else initialize_config_dir(str(folder()), version_base="1.3"):
        composed = compose(
            "config",
            [f"experiment={experiment}"] * bool(experiment) + own,
            return_hydra_config=True,
        )
    groups = composed.hydra.runtime.choices
    for one in (f"{name}/{experiment}", f"{name}/{groups['data']}"):
        if one in options:
            return one
    available = ", ".join(sorted({one.split("/")[1] for one in options if one.startswith(f"{name}/")}))
    raise ConfigError(
        f"preset={name} has no setting for data={groups['data']}; it has one for {available}. Leave it out, or choose "
        "an experiment on one of these."
    )


def _in_resumed_folder(arguments: list[str]) -> list[str]:
    """Set Hydra's run folder to the folder of `resume=<run folder>`, so that Hydra creates no new one."""
    for index, argument in enumerate(arguments):
        key, _, value = argument.partition("=")
        if key == "resume" and value not in ("auto", "never", "null", ""):
            path = Path(value).expanduser()
            if not path.exists() and value[0] in "'\"":
                with suppress(HydraException):
                    path = Path(str(OverridesParser.create().parse_override(argument).value())).expanduser()
            if not (path / "config.yaml").is_file():
                raise ConfigError(
                    f"resume={value}: {path / 'config.yaml'} does not exist. Give the folder of a run, "
                    "as printed at its start (outputs/<experiment>/<time>)."
                )
            here = in_quotes(str(path))
            return [*arguments[:index], f"resume={here}", *arguments[index + 1 :], f"hydra.run.dir={here}"]
    return arguments


def _refuse_code_and_passwords(arguments: list[str]) -> None:
    """Refuse arguments that would run code or store a password, before Hydra reads them.

    Hydra passes its logging configs to logging.config.dictConfig, which calls the functions that they name. Hydra's
    reruns unpickle a file.

    Raises:
        ConfigError: An argument chooses or changes such a config, names such a file, or contains a password.
    """
    for argument in arguments:
        flag = argument.partition("=")[0]
        if flag in ("--experiment", "--exp"):
            raise ConfigError(_no_flag(argument, arguments))
        # argparse accepts abbreviations
        if flag.startswith("--e") and "--experimental-rerun".startswith(flag):
            raise ConfigError(
                f"{argument}: refused, since Hydra unpickles that file, which runs what it holds. Use resume=<folder>, "
                "or repeat the command that the run's overrides.yaml lists."
            )
        if argument.lstrip("+").startswith("logger.uri="):
            require_no_password(argument.partition("=")[2].strip("'\""))
        key = argument.lstrip("+~").partition("=")[0]
        if key.replace(".", "/").startswith(("hydra/job_logging", "hydra/hydra_logging", "hydra/callbacks")):
            raise ConfigError(
                f"{argument}: refused, since Hydra's logging and callback configs can run code. "
                "Set the level with hydra.verbose=true instead."
            )


def _swept_with_experiment(arguments: list[str]) -> list[str]:
    """Return the arguments of a sweep over experiments, with single values written as sweeps over one value.

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
    if not any(one.key_or_group == "experiment" and one.is_sweep_override() for one in parsed.values()):
        return arguments

    def written(argument: str) -> str:
        one = parsed.get(argument)
        if one is None or one.is_sweep_override() or (one.key_or_group or "").startswith("hydra"):
            return argument
        key, _, value = argument.partition("=")
        return f"{key}=choice({value})" if value else argument

    return [written(argument) for argument in arguments]
