"""Session of a command: device, data, model and metrics, built and checked against each other before training."""

import ctypes
import logging
import platform
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import torch
from rich.console import Console
from torch.utils.data import Dataset

from framework.configuration.assembly import (
    Assembly,
    Resolved,
    build_data,
    build_metrics,
    build_objectives,
    build_outliers,
    build_predictor,
    citations,
    metrics_reading_outliers,
    require_outliers,
)
from framework.configuration.citations import entries
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
from framework.distributions.noise import Draw, seed_step
from framework.distributions.protocol import median
from framework.errors import CheckpointError, ConfigError, UserError, shorten
from framework.evaluation.splits import BLOCK, numbers, on_device, require_unique_name, silence
from framework.model import Predictor, fitted_models, learns
from framework.objective import Objective
from framework.prediction import Prediction, true_image
from framework.runs.introduction import introduce, introduce_model, introduce_threads
from framework.runs.job import refuse_idle
from framework.runs.resuming import find_resumable, may_resume
from framework.runs.returned import check_parts, require_inputs, require_losses, require_splits
from framework.runs.run import Run
from framework.storage.checkpoints import read, write
from framework.storage.first_rank import first_rank
from framework.storage.progress import output
from framework.target import Target
from framework.tracking.run_info import MODEL
from framework.training.batches import Batches, require_targets, track_batches
from framework.uncertainty import (
    FollowsTraining,
    ReadsTraining,
    SelfTraining,
    reading_training,
    remarks,
    self_training,
)

if TYPE_CHECKING:  # a metric imports torchmetrics, which predictions do not need
    from framework.metric import Metric

FEW = 8
"""Number of validation samples with which wrappers are tried before training; some wrappers need several samples."""
MOST_COMPARED = 1024
"""Largest number of the user's samples that are read twice to find out whether a setting of the data has an effect."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # constants of malloc.h


@dataclass
class Session:
    """Data, model, metrics and other objects with which a mode works, built from the config of its command.

    Attributes:
        config: Config of the command; for a stored model, with the settings of the model's run that affect its results
            (`inherit_settings`).
        parts: Resolved configs of all plugins, with every parameter.
        method: Name of the model in tables.
        target: Target that is predicted.
        data: Data set; it is prepared, unless only the user's own files are read.
        predictor: Predictor; untrained in a session for training, and trained in a session for a stored model.
        device: Device on which the predictor is evaluated.
        console: Console for the user; it prints nothing in ranks other than the first.
        objectives: Objectives of the training loss.
        metrics: New metrics without any state, in the order of the config; empty before `add_test_parts`.
        outliers: Prepared outliers, if a metric reads them; None before `add_test_parts`.
        stored: Description of the stored model; None in a session for training.
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
    metrics: "Sequence[Metric]" = ()
    outliers: Data | None = None
    stored: Description | None = None

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
        """Return the names of the data and the model, as figures and tables show them."""
        return f"{self.data_title} · {self.method}"

    def batches(self, data: Data | None = None) -> Batches:
        """Return batches of the training batch size from `data`, or from the session's data if `data` is None."""
        chosen = self.settings
        return Batches(
            data or self.data, batch_size=chosen.batch_size, workers=chosen.workers, seed=chosen.seed
        )

    def blocks(self) -> Batches:
        """Return the session's data for evaluation, in blocks of `BLOCK` samples, independent of the batch size."""
        return Batches(self.data, batch_size=BLOCK, workers=self.settings.workers, seed=self.settings.seed)

    def description(self) -> dict[str, Any]:
        """Return the description that a checkpoint contains in addition to the weights."""
        remarks_now = remarks(self.predictor)
        return Description.of(self.parts, self.data, self.method, self.settings, remarks_now).stored()

    def record(self, run: Run) -> None:
        """Record the data sets that the run reads, and write the file of references to cite."""
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
        """Write weights and description to model.ckpt for `framework.load`; the file is also the model in the store."""
        path = run.checkpoints / "model.ckpt"
        state = {f"{PREFIX}{key}": value.cpu() for key, value in self.predictor.state_dict().items()}
        write({"framework": self.description(), "state_dict": state}, path)
        run.tracker.log_artifact(path, MODEL)


def record_citations(run: Run, parts: Resolved) -> None:
    """Write the references to cite into the run folder and the store."""
    path = run.folder / "citations.bib"
    if first_rank():
        path.write_text("\n\n".join(entries(citations(parts).values()).values()) + "\n", encoding="utf-8")
    run.tracker.log_artifact(path)


def set_up_process(settings: Settings) -> Console:
    """Set up threads, memory and Lightning's messages in this process, and return the console to print on."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    keep_memory()
    silence_lightning()
    return output()


def for_training(config: Config) -> Session:
    """Build all plugins from the config, prepare the data, call `rehearse`, and return the session.

    Raises:
        ConfigError: A part is missing or does not fit another.
        DataError: `Data.prepare` fails.
    """
    console = set_up_process(config.settings)
    assembly = config.assembly
    parts, data = assembly.parts, assembly.data
    resumed = may_resume(config)
    if not resumed:
        refuse_unread_outliers(config, parts)
        if issubclass(load("density_head", parts["density_head"]["name"]), Fitted):
            _refuse_training(
                config,
                f"density_head={parts['density_head']['name']} is fitted in one step, without gradient",
            )
    starts_from_weights = config.settings.checkpoint is not None and not (
        resumed and find_resumable(config.folder / "checkpoints")
    )
    start = Start.of(assembly, config.settings) if starts_from_weights else None
    introduce_threads(config.settings.threads, console)
    data.prepare()
    introduce(data, console)
    objectives = build_objectives(parts)
    for objective in objectives:
        objective.check_data(data, parts["data"])
    seed = config.settings.seed
    if start is None:
        head = assembly.take_head(data.target)
        predictor = build_predictor(parts, data.target, data.input_shape, seed, data.columns, head)
    else:
        predictor = start.predictor_for(data, parts, seed)
        hint = "to continue a run that was stopped, use resume=<folder of the run>"
        console.print(f"starting a new training from the weights of {start.path} ({hint})", soft_wrap=True)
    trains_itself = next((part for part in predictor.modules() if isinstance(part, SelfTraining)), None)
    reader = next((part for part in predictor.modules() if isinstance(part, ReadsTraining)), None)
    if trains_itself is not None and reader is not None:
        raise ConfigError(
            f"{type(reader).__name__} reads the training split of the model that it wraps, but "
            f"{type(trains_itself).__name__} trains each model on a part of this split. Remove one of the two from "
            "`uncertainty`."
        )
    if trains_itself is not None and not resumed:
        keys = " and ".join(f"uncertainty.{part['name']}" for part in parts["uncertainty"])
        _refuse_training(
            config, f"{type(trains_itself).__name__} trains its models itself, by its own settings in {keys}"
        )
    if trains_itself is not None and objectives:
        raise ConfigError(
            f"{type(trains_itself).__name__} trains its models itself, so that an objective has no effect. Leave "
            "objective out, or choose another uncertainty."
        )
    _require_whole_training(predictor, config)
    if not learns(predictor) and not resumed:
        _refuse_training(config, "no part of this model learns by gradient")
    if objectives and not learns(predictor):
        raise ConfigError(
            f"density_head={parts['density_head']['name']} is fitted in one step without a gradient, but an objective "
            "acts through the gradient. Leave objective out."
            if fitted_models(predictor)
            else "No part of this model learns by gradient, but an objective acts through the gradient. Leave "
            "objective out."
        )
    device = torch.device("cpu")
    method = method_of(config, parts)
    session = Session(config, parts, method, data.target, data, predictor, device, console, objectives)
    session = _add_metrics(session, assembly.take_metrics(data.target))
    if first_rank():
        rehearse(session)
    return session


def refuse_unread_outliers(config: Config, parts: Resolved) -> None:
    """Refuse settings of outliers if no metric reads outliers.

    Raises:
        ConfigError: The command chooses or changes outliers, but no metric reads them.
    """
    override = config.first_override("outliers")
    if override and not metrics_reading_outliers(parts):
        refuse_idle(config.folder, idle_sentence(override, "no metric of this run reads outliers"))


def _require_whole_training(predictor: Predictor, config: Config) -> None:
    """Refuse settings with which a wrapper of class `FollowsTraining` would not see the whole training.

    Raises:
        ConfigError: Training may stop early, keeps the weights of another epoch than the last, or has no planned number
            of epochs; or the model is not trained by gradient, or a wrapper trains its models itself.
    """
    wrapper = next((part for part in predictor.modules() if isinstance(part, FollowsTraining)), None)
    if wrapper is None:
        return
    name, trainer = type(wrapper).__name__, config.settings.trainer
    if self_training(predictor) is not None or not learns(predictor):
        raise ConfigError(
            f"{name} collects weights after each epoch of a training by gradient, but this model is trained in another "
            "way. Leave this wrapper out, or choose a model that is trained by gradient."
        )
    if trainer.get("keep") != "last" or trainer.get("patience") or (trainer.get("max_epochs") or -1) < 1:
        raise ConfigError(
            f"{name} collects the weights of the last epochs, so that training must not stop early and must keep its "
            f"last weights. Got trainer.keep={trainer.get('keep')}, trainer.patience={trainer.get('patience')} and "
            f"trainer.max_epochs={trainer.get('max_epochs')}. Set trainer.keep=last trainer.patience=null, and a "
            "number of epochs."
        )


def _refuse_training(config: Config, why: str) -> None:
    """Refuse settings for training by gradient in a command that does not train by gradient.

    Raises:
        ConfigError: The command contains such a setting.
    """
    for group in ("optimizer", "trainer"):
        override = config.first_override(group)
        if override:
            refuse_idle(config.folder, idle_sentence(override, why))


@dataclass(frozen=True)
class Start:
    """Weights of an earlier run, from which training starts.

    Attributes:
        path: Path of the checkpoint.
        state: Weights in the checkpoint, by name.
        predictor: Predictor with these weights; None if the checkpoint does not describe a model.
        about: Target, input shape and input columns for which `predictor` was built; None without a predictor.
    """

    path: Path
    state: Mapping[str, torch.Tensor]
    predictor: Predictor | None = None
    about: tuple[Target, tuple[int, ...], tuple[str, ...]] | None = None

    @classmethod
    def of(cls, assembly: Assembly, settings: Settings) -> "Start":
        """Read the weights from which the model starts, and check that they fit before data are read or generated.

        The model is built for the inputs and the target that the checkpoint describes. A target that the data set knows
        before it is prepared takes precedence. `predictor_for` compares the model with the prepared data.

        Raises:
            CheckpointError: There is no checkpoint, or the checkpoint belongs to another model.
        """
        path = find_checkpoint(str(settings.checkpoint), uri=settings.logger.uri)
        content = read(path)
        state, described = predictor_weights(content), content.get("framework")
        if not isinstance(described, Mapping):  # `predictor_for` raises the error about wrong weights
            return cls(path, state)
        stored, shape, columns = read_interface(described, path)
        target = assembly.target or stored
        head = assembly.take_head(target)
        try:
            predictor = build_predictor(assembly.parts, target, shape, settings.seed, columns, head)
        except ConfigError as error:
            raise CheckpointError(
                f"{path} belongs to another model: {error} Use the config of its training, or give another checkpoint."
            ) from error
        fill(predictor, state, str(path))
        return cls(path, state, predictor, (target, shape, columns))

    def predictor_for(self, data: Data, parts: Resolved, seed: int) -> Predictor:
        """Return a predictor with the weights; build it again if the prepared data differ from the description.

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

    The name is that of the experiment, or of the density head if there is no experiment, followed by the uncertainty
    wrappers. With an experiment, the wrappers are listed only if the command changes them. The wrapper after which the
    experiment is named is never listed.
    """
    name = config.settings.experiment_name
    method = name.rpartition("/")[2] if name else str(parts["density_head"]["name"])
    changed = any(item.lstrip("+~").startswith("uncertainty") for item in config.overrides)
    wrappers = [part["name"] for part in parts["uncertainty"]] if changed or not name else []
    return " + ".join([method, *(wrapper for wrapper in wrappers if wrapper != method)])


def add_test_parts(session: Session) -> Session:
    """Return the session with the parts of a test added: new metrics, and outliers if a metric reads them.

    Raises:
        ConfigError: A metric does not fit the target, or needs outliers although none are configured.
        DataError: `Data.prepare` fails.
    """
    parts = session.parts
    # metrics of a checkpoint are checked only here, because a model predicts without them
    parts = {**parts, "metric": [resolve("metric", part) for part in parts["metric"]]}
    require_outliers(parts)
    return _add_metrics(replace(session, parts=parts), build_metrics(parts, session.target))


def _add_metrics(session: Session, metrics: "Sequence[Metric]") -> Session:
    owners: dict[str, Metric] = {}
    for metric in metrics:
        for name in metric.columns:
            require_unique_name(owners, name, metric)
    return replace(session, metrics=metrics, outliers=build_outliers(session.parts, session.data))


@torch.no_grad()
def rehearse(session: Session) -> None:
    """Try the steps that follow training with a few samples, so that errors in these steps appear before training.

    The function checks a few targets, lets the untrained model predict two samples, checks what each of its parts
    returns, updates every metric with these predictions, and calibrates a copy of the model. A model that is fitted in
    one step cannot predict before the fit. For such a model, the function only checks the targets, and that the batches
    have the images that metrics compare with predicted images.

    Raises:
        UserError: The data, a metric or an uncertainty wrapper fails with these samples.
    """
    fitted, reads = (
        bool(fitted_models(session.predictor)),
        {name for metric in session.metrics for name in metric.reads},
    )
    splits = require_splits(session.data)
    validation_batch = _first_samples(splits.validation, 2)
    for batch in (_first_samples(splits.train, 2), validation_batch, _first_samples(splits.test, 2)):
        require_targets(batch, session.target)
        require_inputs(batch, session.data)
    if fitted:
        for channel in sorted(reads):
            true_image(validation_batch, channel)
        return
    seed_step(session.settings.seed, 0, "rehearsal")
    training = session.predictor.training
    # before calibration, a wrapper may warn that its results mean nothing
    with silence(), check_parts(session.predictor, session.target):
        density = session.predictor.eval()(validation_batch["input"])
        if learns(session.predictor) and self_training(session.predictor) is None:
            losses = session.predictor.loss(validation_batch["input"], validation_batch["target"])
            require_losses(losses, session.predictor, len(validation_batch["input"]))
    session.predictor.train(training)
    samples = session.settings.samples
    predictions = [Prediction(density, validation_batch, samples)]
    if session.outliers is not None:  # validation samples serve as outliers here
        predictions.append(Prediction(density, validation_batch, samples, "outliers"))
    # with so few samples, warnings have no meaning
    with silence():
        for metric in session.metrics:
            trial = metric.clone()
            for prediction in predictions:
                if prediction.split in metric.splits:
                    trial.update(prediction)  # type: ignore[operator]  # torchmetrics types what it wraps as a module
            numbers([cast("Metric", trial)])
        few = validation_batch if not session.parts["uncertainty"] else _first_samples(splits.validation, FEW)
        with torch.enable_grad():
            trial_predictor = deepcopy(session.predictor).eval()
            with reading_training(trial_predictor, [_first_samples(splits.train, FEW)]):
                trial_predictor.calibrate([few])


def _first_samples(dataset: Dataset[Batch], most: int) -> Batch:
    """Return a batch of the first samples, at most `most`."""
    return fetch(dataset, range(min(most, len(dataset))))  # type: ignore[arg-type]


def for_trained(config: Config, *, prepare: bool = True) -> Session:
    """Return the session of the trained model that the setting `checkpoint` names.

    The command line may choose data, outliers and metrics; those that it does not choose are taken from the model's own
    run. If `prepare` is False, the data set generates and loads no data, and can only read the user's own files.

    Raises:
        ConfigError: The command names no checkpoint.
        CheckpointError: The checkpoint does not exist, or the data do not fit the model.
    """
    console = set_up_process(config.settings)
    if config.settings.checkpoint is None:
        raise ConfigError(
            f"mode={config.mode} needs checkpoint=<run folder, checkpoint file or MLflow run id>."
        )
    predictor, description = load_with_description(
        config.settings.checkpoint, uri=config.settings.logger.uri, paths=flatten(config.settings.stored)
    )
    return for_predictor(config, predictor, description, console, prepare=prepare)


def for_predictor(
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
        group
        for group in ("data", "outliers", "metric")
        if group in reads and getattr(config.settings, group)
    }
    # the groups that the mode does not read are left as they are, and their plugins are not imported
    stored_parts = {
        group: parts.get(group) for group in ("outliers", "metric") if group in reads and group not in chosen
    }
    repeated = {
        key: value
        for key, value in flatten(config.settings.stored).items()
        if key.partition(".")[0] in stored_parts
    }
    stored_parts, dropped = remove_paths(stored_parts, repeated)
    parts |= stored_parts
    dropped |= {
        key: value for key, value in description.dropped.items() if key.partition(".")[0] not in chosen
    }
    config = replace(inherit_settings(config, description), trained_on=str(parts["data"]["name"]))
    for group in chosen - {"metric"}:
        parts[group] = resolve("data", getattr(config.settings, group), group)
    if "metric" in chosen:
        metrics = config.settings.metric
        parts["metric"] = [resolve("metric", part, f"metric.{key}") for key, part in metrics.items()]
    if "outliers" in reads and not may_resume(config):
        refuse_unread_outliers(config, parts)
    chosen_data = None
    if prepare:
        outliers = "outliers" in {*reads} - chosen and bool(metrics_reading_outliers(parts))
        groups = ["data", *["metric"] * ("metric" in reads), *["outliers"] * outliers]
        require_paths(dropped, groups, description.path)
        if "data" in chosen:
            chosen_data = build_data(parts)
            require_target(getattr(chosen_data, "target", None), description)
    data = reader(replace(description, config=parts, dropped=dropped), chosen_data)
    if prepare:
        data.prepare()
        require_fit(data, description)
    elif "data" in chosen or "data" in config.settings.stored:
        begun = None if may_resume(config) else config
        data.read = partial(_read_files, data.read, data, description, begun)  # type: ignore[method-assign]
    method = description.method or method_of(config, parts)
    introduce_model(description, method, data if prepare else None, console)
    return Session(
        config, parts, method, description.target, data, predictor, device, console, stored=description
    )


def _read_files(
    read: Callable[[Sequence[Path]], Dataset[Batch]],
    data: Data,
    description: Description,
    config: Config | None,
    files: Sequence[Path],
) -> Dataset[Batch]:
    """Read the user's own files with a data set that the command chooses or changes.

    Args:
        read: Method `read` of the data set.
        data: Data set.
        description: Description of the model.
        config: Config of the command; None for a resumed run, which may contain a choice without effect.
        files: Files of the user.

    Raises:
        CheckpointError: The first sample has another shape than the inputs of the model.
        ConfigError: The choice of the data set has no effect: the model's own data set reads the same samples. If more
            than `MOST_COMPARED` samples would have to be compared, a note is printed instead.
    """
    samples = read(files)
    first_shape, model_shape = tuple(fetch(samples, range(1))["input"].shape[1:]), description.input_shape
    free = len(model_shape) == 2  # a point cloud has any number of points
    if first_shape[free:] != model_shape[free:] or len(first_shape) != len(model_shape):
        raise CheckpointError(
            f"{description.path} reads inputs of shape {model_shape}, but "
            f"data={description.config['data']['name']} with the settings of this command reads {files[0]} as an input "
            f"of shape {first_shape}. Leave data out; the model's own data set is then used."
        )
    override = None if config is None else config.first_override("data")
    if config is not None and override is not None and not isinstance(data, Mapped):
        skips = any(
            "unreadable=" in item for item in config.overrides
        )  # the mode reads this key, not the data set
        count = None if skips else _count_idle_samples(description, read, files)
        if count == len(samples):  # type: ignore[arg-type]
            refuse_idle(
                config.folder,
                idle_sentence(override, f"the model reads {files[0]} in the same way without it"),
            )
        elif count is not None:
            note = f"note: {shorten(override)} changes nothing in the first {count} of {len(samples)} samples"  # type: ignore[arg-type]
            output().print(note, soft_wrap=True, highlight=False, markup=False)
    return samples


def _count_idle_samples(
    description: Description, read_chosen: Callable[[Sequence[Path]], Dataset[Batch]], files: Sequence[Path]
) -> int | None:
    """Compare the model's own data set with the chosen one; return the number of equal samples, None if one differs.

    The first samples of the files are compared, as `_count_equal_samples` describes. The result is also None if the
    model's own data set cannot read the files.

    Args:
        description: Description of the model.
        read_chosen: Method `read` of the data set that the command chooses.
        files: Files of the user.
    """
    stored = read(Path(description.path))["framework"]["config"]["data"]
    try:
        config, _ = remove_paths({"data": stored}, {})
        data = reader(replace(description, config={**description.config, **config}, dropped={}))
        return _count_equal_samples(data, read_chosen, files)
    except UserError:  # for example, the data set needs a path that only the command gives
        return None


def _count_equal_samples(
    stored: Data, read_chosen: Callable[[Sequence[Path]], Dataset[Batch]], files: Sequence[Path]
) -> int | None:
    """Compare the samples that two data sets read from the first files; return their number, or None if one differs.

    Args:
        stored: Data set that the model was trained on.
        read_chosen: Method `read` of the data set that the command chooses.
        files: Files of the user, which are compared in order until `MOST_COMPARED` samples have been read.
    """
    count = 0
    for first in range(0, len(files), FEW):
        pair = [read_files(files[first : first + FEW]) for read_files in (stored.read, read_chosen)]
        sizes = [len(samples) for samples in pair]  # type: ignore[arg-type]
        if sizes[0] != sizes[1]:
            return None
        for start in range(0, sizes[0], BLOCK):
            if count >= MOST_COMPARED:
                return count
            rows = range(start, min(start + BLOCK, sizes[0]))
            one, other = (fetch(samples, rows) for samples in pair)
            if one.keys() != other.keys() or not all(torch.equal(one[key], other[key]) for key in one):
                return None
            count += len(rows)
    return count


def inherit_settings(config: Config, description: Description) -> Config:
    """Return the config with the settings of the model's own run, except those that the command line sets."""
    overridden = {item.lstrip("+~").partition("=")[0] for item in config.overrides}
    inherited_values = {
        key: value
        for key, value in description.settings.items()
        if key.removesuffix("_name") not in overridden
    }
    return replace(
        config,
        settings=config.settings.model_copy(update=inherited_values),
    )


def require_fit(data: Data, description: Description) -> None:
    """Refuse prepared data if the model cannot read their inputs or predicts other targets.

    Raises:
        CheckpointError: The inputs have another shape, or the targets differ.
    """
    target = description.target
    expected = description.input_shape, target.kind, target.names, target.size
    actual = data.input_shape, data.target.kind, data.target.names, data.target.size
    if expected != actual:
        raise CheckpointError(
            f"{description.path} reads inputs of shape {expected[0]} and predicts {expected[1]} "
            f"({target.listed_names}), but the data have inputs of shape {actual[0]} and targets {actual[1]} "
            f"({data.target.listed_names}). Give data like those of the training."
        )


def require_target(target: Target | None, description: Description) -> None:
    """Raise an error if the target of the data differs from the target of the stored model.

    Args:
        target: Target of the data; None if it is known only after the data are read, in which case nothing is checked.
        description: Description of the stored model.

    Raises:
        CheckpointError: The targets differ.
    """
    expected = description.target
    if target is not None and (target.kind, target.names, target.size) != (
        expected.kind,
        expected.names,
        expected.size,
    ):
        raise CheckpointError(
            f"{description.path} predicts {expected.kind} ({expected.listed_names}), but the data have targets "
            f"{target.kind} ({target.listed_names}). Give data like those of the training."
        )


def calibrate(session: Session) -> None:
    """Calibrate the session's predictor on the validation split, and print the remarks of its wrappers and heads."""
    session.predictor.eval().to(session.device)
    seed_step(session.settings.seed, 0, "calibrate")
    if session.config.mode == "train" and self_training(session.predictor) is not None:
        batches = trained_batches(session.blocks())
    else:
        batches = track_batches(session.blocks().val_dataloader(), "calibrating")
    with reading_training(session.predictor, _TrainingSplit(session)):
        session.predictor.calibrate(on_device(batches, session.device))
    for remark in remarks(session.predictor):
        session.console.print(remark, soft_wrap=True, highlight=False, markup=False)


@dataclass(frozen=True)
class _TrainingSplit:
    """Batches of a session's training split, on its device and without augmentation, loaded at each iteration."""

    session: Session

    def __iter__(self) -> Iterator[Batch]:
        session = self.session
        return on_device(session.blocks().of(session.data.splits().train), session.device)


def trained_batches(batches: Batches) -> Iterator[Batch]:
    """Yield the batches of the training and the validation split, on which a wrapper trains its models itself.

    Each batch also has the field "row": the number, from 0, of each of its samples among the samples of both splits.
    """
    first = 0
    splits = batches.data.splits()
    for split in (splits.train, splits.validation):
        for batch in batches.of(split):
            count = len(batch["input"])
            yield {**require_targets(batch, batches.data.target), "row": torch.arange(first, first + count)}
            first += count


@torch.no_grad()
def note_idle_samples(session: Session, batch: Batch) -> None:
    """Print a note if the command sets `samples`, but the point predictions of the model need no samples.

    Args:
        session: Session with a trained predictor on the session's device.
        batch: Inputs for which the model predicts.
    """
    override = session.config.first_override("samples")
    if override is None:
        return
    with Draw(0, 0)("density"):
        density = session.predictor(batch["input"].to(session.device))
    points = []
    for seed, samples in ((0, 1), (1, 3)):
        with Draw(seed, 0)("point"):
            points.append(median(density, samples))
    if torch.equal(*points):
        why = "the point predictions of this model have a closed form, which needs no samples"
        session.console.print(f"note: {idle_sentence(override, why)}", soft_wrap=True, markup=False)


def keep_memory() -> None:
    """Make glibc keep freed memory for this process, because every training step frees and requests the same megabytes.

    If glibc returned the memory to the system, each step would cause thousands of page faults, which take a quarter of
    the training time of a small network. On a system without glibc, the function does nothing.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def silence_lightning() -> None:
    """Silence messages of Lightning about missing hardware and its own deprecations, which do not help the user."""
    for name in ("pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=".*LeafSpec", module="pytorch_lightning")
    warnings.filterwarnings("ignore", message=".*does not have many workers", module="pytorch_lightning")
    # networks whose weights and batch norm are frozen stay in evaluation mode
    warnings.filterwarnings(
        "ignore", message=r"Found \d+ module\(s\) in eval mode", module="pytorch_lightning"
    )
    # a cluster node that is used without SLURM
    warnings.filterwarnings("ignore", message="The `srun` command is available on your system")
    # the framework's data loader is resumable in a way that Lightning does not detect
    warnings.filterwarnings(
        "ignore", message=".*your dataloader is not resumable", module="pytorch_lightning"
    )
