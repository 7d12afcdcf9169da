"""Session of a command: threads, device and all parts, built and checked against each other before training."""

import ctypes
import logging
import platform
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import torch
from rich.console import Console
from torch.utils.data import Dataset

from framework.configuration.assembly import (
    Resolved,
    build_data,
    build_metrics,
    build_objectives,
    build_outliers,
    build_predictor,
    citations,
    entries,
    metrics_reading_outliers,
    require_outliers,
)
from framework.configuration.config import Config
from framework.configuration.description import Description
from framework.configuration.loading import (
    PREFIX,
    fill,
    find_checkpoint,
    load_with_description,
    predictor_weights,
    read_interface,
    reader,
)
from framework.configuration.modes import MODES, idle_sentence
from framework.configuration.paths import flatten, remove_paths, require_paths
from framework.configuration.registry import load
from framework.configuration.schema import resolve
from framework.configuration.settings import Settings, device_of
from framework.data import Batch, Data, Mapped
from framework.datasets.fields import fetch
from framework.density_head import Fitted
from framework.distributions.noise import seed_step
from framework.errors import CheckpointError, ConfigError, UserError
from framework.evaluation.splits import BLOCK, numbers, on_device, require_unique_name
from framework.metric import Metric
from framework.model import Predictor, fitted_models, learns
from framework.objective import Objective
from framework.prediction import Prediction, true_image
from framework.runs.introduction import introduce, introduce_model, introduce_threads
from framework.runs.job import refuse_idle
from framework.runs.run import Run, goes_on
from framework.storage.checkpoints import read
from framework.storage.first_rank import first_rank
from framework.storage.progress import output
from framework.target import Target
from framework.tracking.run_info import MODEL
from framework.training.batches import Batches, require_targets, track_batches
from framework.training.checkpoint import WholeCheckpoints, find_resumable
from framework.uncertainty import remarks

FEW = 8
"""Number of validation samples with which wrappers are tried before training, since some need more than one."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # constants of malloc.h


@dataclass
class Session:
    """Objects with which a mode works.

    Attributes:
        config: Config of the command; in a test, settings that affect its numbers come from the model's own run.
        parts: Every plugin with every parameter, as they were built.
        method: Name of the model in tables.
        target: Target that is predicted.
        data: Data set, prepared unless only a user's own files are read.
        predictor: Predictor, untrained or as loaded.
        device: Device on which the predictor is evaluated.
        console: Console for people; it prints nothing in ranks other than the first.
        objectives: Objectives of the training loss.
        metrics: New metrics without any state, in the order of the config; empty before `tested`.
        outliers: Prepared outliers, if a metric reads them; None before `tested`.
    """

    config: Config
    parts: Resolved
    method: str
    target: Target
    data: Data
    predictor: Predictor
    device: torch.device
    console: Console
    objectives: Sequence[Objective] = ()
    metrics: Sequence[Metric] = ()
    outliers: Data | None = None

    @property
    def settings(self) -> Settings:
        """Return the settings of the command."""
        return self.config.settings

    @property
    def data_title(self) -> str:
        """Return the name of the data in figures and tables."""
        data = self.data
        return data.title or (data.groups[0] if len(data.groups) == 1 else self.parts["data"]["name"])

    @property
    def title(self) -> str:
        """Return the name of data and model in figures and tables."""
        return f"{self.data_title} · {self.method}"

    def batches(self, data: Data | None = None) -> Batches:
        """Return the training batches of the session's data, or of `data`, which replaces them."""
        chosen = self.settings
        return Batches(
            data or self.data, batch_size=chosen.batch_size, workers=chosen.workers, seed=chosen.seed
        )

    def blocks(self) -> Batches:
        """Return the session's data for evaluation, in blocks of one size whatever the batch size is."""
        return Batches(self.data, batch_size=BLOCK, workers=self.settings.workers, seed=self.settings.seed)

    def description(self) -> dict[str, Any]:
        """Return the description that a checkpoint holds beside the weights."""
        remarks_now = remarks(self.predictor)
        return Description.of(self.parts, self.data, self.method, self.settings, remarks_now).stored()

    def record(self, run: Run) -> None:
        """Record the data sets that the run reads, and write the references to cite."""
        for role, data in (("data", self.data), ("outliers", self.outliers)):
            if data is not None:
                about = {"synthetic": str(data.synthetic).lower(), "skipped": str(data.skipped)}
                facts = {**data.fingerprint(), **about}
                run.tracker.set_tags({f"{role}.{key}": value for key, value in facts.items()})
                mode = "training" if run.config.mode == "train" else run.config.mode
                context = mode if role == "data" else role
                run.tracker.log_dataset(self.parts[role]["name"], context, facts)
        record_citations(run, self.parts)

    def save_model(self, run: Run) -> None:
        """Write weights and description for `framework.load`; the file is also the run's model in the store."""
        path = run.checkpoints / "model.ckpt"
        state = {f"{PREFIX}{key}": value.cpu() for key, value in self.predictor.state_dict().items()}
        WholeCheckpoints().save_checkpoint({"framework": self.description(), "state_dict": state}, path)
        run.tracker.log_artifact(path, MODEL)


def record_citations(run: Run, parts: Resolved) -> None:
    """Write the references to cite into the run folder and the store."""
    path = run.folder / "citations.bib"
    if first_rank():
        path.write_text("\n\n".join(entries(citations(parts).values()).values()) + "\n", encoding="utf-8")
    run.tracker.log_artifact(path)


def begin(settings: Settings) -> Console:
    """Set up threads, memory and Lightning's messages in this process, and return the console to print on."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    keep_memory()
    quiet()
    return output()


def for_training(config: Config) -> Session:
    """Build everything from the config, prepare the data, try the metrics on a prediction, and return the session.

    Raises:
        ConfigError: A part is missing or does not fit another.
        DataError: `Data.prepare` fails.
    """
    console = begin(config.settings)
    parts = config.parts
    resumed = goes_on(config)
    if not resumed:
        refuse_unread_outliers(config, parts)
        if issubclass(load("density_head", parts["density_head"]["name"]), Fitted):
            _refuse_training(
                config, f"density_head={parts['density_head']['name']} is fitted at once, without gradient"
            )
    data = build_data(parts)
    started = config.settings.checkpoint is not None and not (
        resumed and find_resumable(config.folder / "checkpoints")
    )
    start = Start.of(parts, data, config.settings) if started else None
    introduce_threads(config.settings.threads, console)
    data.prepare()
    introduce(data, console)
    objectives = build_objectives(parts)
    seed = config.settings.seed
    if start is None:
        predictor = build_predictor(parts, data.target, data.input_shape, seed, columns=data.columns)
    else:
        predictor = start.predictor_for(data, parts, seed)
        said = "a run that was stopped goes on with resume=<its folder>"
        console.print(f"starting anew from the weights of {start.path} ({said})", soft_wrap=True)
    if not learns(predictor) and not resumed:
        _refuse_training(config, "nothing in this model learns by gradient")
    if objectives and not learns(predictor):
        raise ConfigError(
            f"density_head={parts['density_head']['name']} is fitted at once and has no gradient, which objectives "
            "work by. Leave objective out."
            if fitted_models(predictor)
            else "Nothing in this model learns by gradient, which objectives work by. Leave objective out."
        )
    device = torch.device("cpu")
    method = method_of(config, parts)
    session = Session(config, parts, method, data.target, data, predictor, device, console, objectives)
    session = tested(session)
    if first_rank():
        rehearse(session)
    return session


def refuse_unread_outliers(config: Config, parts: Resolved) -> None:
    """Refuse outliers that the command chooses although no metric reads them.

    Raises:
        ConfigError: The command chooses outliers, and no metric reads them.
    """
    given = config.first_override("outliers")
    if given and not metrics_reading_outliers(parts):
        refuse_idle(config.folder, idle_sentence(given, "no metric of this run reads outliers"))


def _refuse_training(config: Config, why: str) -> None:
    """Refuse settings for training by gradient in a command that does not train by gradient.

    Raises:
        ConfigError: The command contains such a setting.
    """
    for group in ("optimizer", "trainer"):
        given = config.first_override(group)
        if given:
            refuse_idle(config.folder, idle_sentence(given, why))


@dataclass(frozen=True)
class Start:
    """Weights of an earlier run, from which training starts.

    Attributes:
        path: Path of the checkpoint.
        state: Weights in the checkpoint, by name.
        predictor: Predictor with these weights; None if the checkpoint does not describe a model.
        about: Target, input shape and input columns for which `predictor` was built.
    """

    path: Path
    state: Mapping[str, torch.Tensor]
    predictor: Predictor | None = None
    about: tuple[Target, tuple[int, ...], tuple[str, ...]] | None = None

    @classmethod
    def of(cls, parts: Resolved, data: Data, settings: Settings) -> "Start":
        """Read the weights from which the model starts, and check that they fit it before data is read or generated.

        The model is built for the target and the inputs that the checkpoint describes; if the data set already knows
        its target, that target is used. `predictor_for` compares the model with the prepared data.

        Raises:
            CheckpointError: There is no checkpoint, or it belongs to another model.
        """
        path = find_checkpoint(str(settings.checkpoint), uri=settings.logger.uri)
        content = read(path)
        state, described = predictor_weights(content), content.get("framework")
        if not isinstance(described, Mapping):  # `predictor_for` raises the error about wrong weights
            return cls(path, state)
        stored, shape, columns = read_interface(described, path)
        target = getattr(data, "target", None) or stored
        try:
            predictor = build_predictor(parts, target, shape, settings.seed, columns)
        except ConfigError as error:
            raise CheckpointError(
                f"{path} belongs to another model: {error} Use the config it was trained with, or another checkpoint."
            ) from error
        fill(predictor, state, str(path))
        return cls(path, state, predictor, (target, shape, columns))

    def predictor_for(self, data: Data, parts: Resolved, seed: int) -> Predictor:
        """Return a predictor with the weights; it is built again if the prepared data differ from the description.

        Raises:
            CheckpointError: The weights belong to another model.
        """
        if self.predictor is not None and self.about == (data.target, data.input_shape, data.columns):
            return self.predictor
        predictor = build_predictor(parts, data.target, data.input_shape, seed, columns=data.columns)
        fill(predictor, self.state, str(self.path))
        return predictor


def method_of(config: Config, parts: Resolved) -> str:
    """Return the name of a model in tables.

    It is the experiment, or the density head if there is none, followed by the uncertainty wrappers. The wrappers that
    belong to an experiment are not listed.
    """
    name = config.settings.experiment_name
    method = name.rpartition("/")[2] if name else str(parts["density_head"]["name"])
    changed = any(item.lstrip("+~").startswith("uncertainty") for item in config.overrides)
    wrappers = [part["name"] for part in parts["uncertainty"]] if changed or not name else []
    return " + ".join([method, *wrappers])


def tested(session: Session) -> Session:
    """Return the session with the parts of a test added: new metrics, and outliers if a metric reads them.

    Raises:
        ConfigError: A metric does not fit the target, or needs outliers and there are none.
        DataError: `Data.prepare` fails.
    """
    parts = session.parts
    # metrics of a checkpoint are checked here, where they are used, since a model predicts without them
    parts = {**parts, "metric": [resolve("metric", part) for part in parts["metric"]]}
    require_outliers(parts)
    metrics = build_metrics(parts, session.target)
    owners: dict[str, Metric] = {}
    for metric in metrics:
        for name in metric.columns:
            require_unique_name(owners, name, metric)
    return replace(session, parts=parts, metrics=metrics, outliers=build_outliers(parts, session.data))


@torch.no_grad()
def rehearse(session: Session) -> None:
    """Try the steps after training on a few samples, so that their errors appear before training.

    The function checks a few targets, gives every metric predictions of two samples by the untrained model, and
    calibrates a copy of the model. If the model predicts nothing before it is fitted, the function only checks that the
    true images exist.

    Raises:
        UserError: The data, a metric or a wrapper raises it.
    """
    fitted, reads = (
        bool(fitted_models(session.predictor)),
        {name for each in session.metrics for name in each.reads},
    )
    splits = session.data.splits()
    some = _few(splits.validation, 2)
    for batch in (_few(splits.train, 2), some, _few(splits.test, 2)):
        require_targets(batch, session.target)
    if fitted:
        for channel in sorted(reads):
            true_image(some, channel)
        return
    seed_step(session.settings.seed, 0, "rehearsal")
    training = session.predictor.training
    density = session.predictor.eval()(some["input"])
    session.predictor.train(training)
    samples = session.settings.samples
    predictions = [Prediction(density, some, samples)]
    if session.outliers is not None:  # test samples serve as outliers here
        predictions.append(Prediction(density, some, samples, "outliers"))
    # warnings about so few samples mean nothing
    with _silence():
        for metric in session.metrics:
            trial = metric.clone()
            for prediction in predictions:
                if prediction.split in metric.splits:
                    trial.update(prediction)  # type: ignore[operator]  # torchmetrics types what it wraps as a module
            numbers([cast(Metric, trial)])
        few = some if not session.parts["uncertainty"] else _few(splits.validation, FEW)
        with torch.enable_grad():
            deepcopy(session.predictor).eval().calibrate([few])


def _few(dataset: Dataset[Batch], most: int) -> Batch:
    """Return a batch of the first samples, at most `most`."""
    return fetch(dataset, range(min(most, len(dataset))))  # type: ignore[arg-type]


@contextmanager
def _silence() -> Iterator[None]:
    """Suppress warnings and log messages below the level of an error during the block."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def for_trained(config: Config, *, prepare: bool = True) -> Session:
    """Return the session of a trained model: the one that `checkpoint` names.

    Data, outliers and metrics are those that the command line names, or else the model's own. Without `prepare`, the
    data can only read a user's own files, and nothing is generated or loaded for them.

    Raises:
        ConfigError: No checkpoint is named.
        CheckpointError: There is no such checkpoint, or the data does not fit the model.
    """
    console = begin(config.settings)
    if config.settings.checkpoint is None:
        raise ConfigError(
            f"mode={config.mode} needs checkpoint=<run folder, checkpoint file or MLflow run id>."
        )
    predictor, description = load_with_description(
        config.settings.checkpoint, uri=config.settings.logger.uri, paths=flatten(config.settings.stored)
    )
    return around(config, predictor, description, console, prepare=prepare)


def around(
    config: Config, predictor: Predictor, description: Description, console: Console, *, prepare: bool = True
) -> Session:
    """Return the session of a loaded predictor that a checkpoint describes; see `for_trained`.

    Raises:
        ConfigError: `prepare` is True, and the command does not repeat a path of the stored data, outliers or metrics.
    """
    reads = MODES[config.mode].reads
    chosen_device = config.settings.trainer.get("accelerator") if "trainer.accelerator" in reads else "cpu"
    device = device_of(chosen_device)
    parts: Resolved = {**description.config}
    chosen = {
        group for group in ("data", "outliers", "metric") if group in reads and config.values.get(group)
    }
    used = {group: parts.get(group) for group in ("outliers", "metric") if group not in chosen}
    again = {
        key: value for key, value in flatten(config.settings.stored).items() if key.partition(".")[0] in used
    }
    used, dropped = remove_paths(used, again)
    parts |= used
    dropped |= {
        key: value for key, value in description.dropped.items() if key.partition(".")[0] not in chosen
    }
    config = replace(inherited(config, description), trained_on=str(parts["data"]["name"]))
    for group in chosen - {"metric"}:
        parts[group] = resolve("data", config.values[group], group)
    if "metric" in chosen:
        metrics = config.values["metric"]
        parts["metric"] = [resolve("metric", part, f"metric.{key}") for key, part in metrics.items()]
    if "outliers" in reads and not goes_on(config):
        refuse_unread_outliers(config, parts)
    if prepare:
        outliers = "outliers" in {*reads} - chosen and bool(metrics_reading_outliers(parts))
        groups = ["data", *["metric"] * ("metric" in reads), *["outliers"] * outliers]
        require_paths(dropped, groups, description.path)
        if "data" in chosen:
            require_target(getattr(build_data(parts), "target", None), description)
    data = reader(replace(description, config=parts, dropped=dropped))
    if prepare:
        data.prepare()
        require_fit(data, description)
    elif "data" in chosen or "data" in config.settings.stored:
        begun = None if goes_on(config) else config
        data.read = partial(_reading, data.read, data, description, begun)  # type: ignore[method-assign]
    method = description.method or method_of(config, parts)
    introduce_model(description, method, data if prepare else None, console)
    return Session(config, parts, method, description.target, data, predictor, device, console)


def _reading(
    read: Callable[[Sequence[Path]], Dataset[Batch]],
    data: Data,
    description: Description,
    config: Config | None,
    files: Sequence[Path],
) -> Dataset[Batch]:
    """Read a user's own files with a data set that the command chose or changed.

    Args:
        read: Method `read` of the data set.
        data: Data set.
        description: Description of the model.
        config: Config of the command; None for a resumed run, whose settings are not checked again.
        files: Files of the user.

    Raises:
        CheckpointError: The first sample has another shape than the model reads.
        ConfigError: The choice has no effect, since the model alone reads the first files in the same way.
    """
    samples = read(files)
    found, wanted = tuple(fetch(samples, range(1))["input"].shape[1:]), description.input_shape
    free = len(wanted) == 2  # a point cloud has any number of points
    if found[free:] != wanted[free:] or len(found) != len(wanted):
        raise CheckpointError(
            f"{description.path} reads inputs of shape {wanted}, but with data={description.config['data']['name']} as "
            f"this command sets it {files[0]} is one of shape {found}. Leave data out: the model knows its own."
        )
    given = None if config is None else config.first_override("data")
    if config is not None and given is not None and not isinstance(data, Mapped):
        skips = any(
            "unreadable=" in item for item in config.overrides
        )  # the mode reads this key, not the data set
        some = list(files[:FEW])
        if not skips and _same_samples(_by_itself(description, some), read(some)):
            refuse_idle(
                config.folder, idle_sentence(given, f"the model reads {files[0]} the same without it")
            )
    return samples


def _by_itself(description: Description, files: Sequence[Path]) -> Dataset[Batch] | None:
    """Return the samples of files as the model reads them without the command's data settings; None if it cannot."""
    stored = read(Path(description.path))["framework"]["config"]["data"]
    try:
        config, _ = remove_paths({"data": stored}, {})
        return reader(replace(description, config={**description.config, **config}, dropped={})).read(files)
    except UserError:  # for example, the data need a path that only the command gives
        return None


def _same_samples(one: Dataset[Batch] | None, other: Dataset[Batch]) -> bool:
    if one is None or len(one) != len(other):  # type: ignore[arg-type]
        return False
    first, second = (fetch(each, range(min(BLOCK, len(each)))) for each in (one, other))  # type: ignore[arg-type]
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


def inherited(config: Config, description: Description) -> Config:
    """Return the config with the settings of the model's own run, except those that the command line sets."""
    given = {item.lstrip("+~").partition("=")[0] for item in config.overrides}
    kept = {
        key: value for key, value in description.settings.items() if key.removesuffix("_name") not in given
    }
    return replace(config, values={**config.values, **kept}, settings=config.settings.model_copy(update=kept))


def require_fit(data: Data, description: Description) -> None:
    """Refuse data with other inputs or targets than the model's.

    Raises:
        CheckpointError: The inputs have another shape, or the targets differ.
    """
    target = description.target
    wanted = description.input_shape, target.kind, target.names, target.size
    found = data.input_shape, data.target.kind, data.target.names, data.target.size
    if wanted != found:
        raise CheckpointError(
            f"{description.path} reads inputs of shape {wanted[0]} and predicts {wanted[1]} ({target.listed_names}), "
            f"but the data has inputs of shape {found[0]} and targets {found[1]} ({data.target.listed_names}). Give "
            "the data it was trained on."
        )


def require_target(target: Target | None, description: Description) -> None:
    """Refuse data whose targets are known before it is read or generated, and differ from the model's.

    Raises:
        CheckpointError: The targets differ.
    """
    wanted = description.target
    if target is not None and (target.kind, target.names, target.size) != (
        wanted.kind,
        wanted.names,
        wanted.size,
    ):
        raise CheckpointError(
            f"{description.path} predicts {wanted.kind} ({wanted.listed_names}), but the data has targets "
            f"{target.kind} ({target.listed_names}). Give the data it was trained on."
        )


def calibrate(session: Session) -> None:
    """Calibrate the session's predictor on the validation split, and print its remarks."""
    session.predictor.eval().to(session.device)
    seed_step(session.settings.seed, 0, "calibrate")
    batches = track_batches(session.blocks().val_dataloader(), "calibrating")
    session.predictor.calibrate(on_device(batches, session.device))
    for remark in remarks(session.predictor):
        session.console.print(remark, soft_wrap=True, highlight=False, markup=False)


def keep_memory() -> None:
    """Make glibc keep freed memory, since every training step frees and requests the same megabytes.

    Otherwise each step causes thousands of page faults, which take a quarter of a small network's time. Without glibc
    the function does nothing.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def quiet() -> None:
    """Silence messages of Lightning that do not help the user: missing hardware, and its own deprecations."""
    for name in ("pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=".*LeafSpec", module="pytorch_lightning")
    warnings.filterwarnings("ignore", message=".*does not have many workers", module="pytorch_lightning")
    # a cluster node that is used without SLURM
    warnings.filterwarnings("ignore", message="The `srun` command is available on your system")
    # the framework's data loader is resumable in a way that Lightning does not detect
    warnings.filterwarnings(
        "ignore", message=".*your dataloader is not resumable", module="pytorch_lightning"
    )
