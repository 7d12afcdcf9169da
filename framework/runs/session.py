"""A session: threads, device, and all parts of a command, built and matched before a step is trained."""

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
    reading_outliers,
    require_outliers,
)
from framework.configuration.config import Config
from framework.configuration.description import Description
from framework.configuration.loading import (
    PREFIX,
    fill,
    find_checkpoint,
    interface,
    load_with_description,
    reader,
    weights,
)
from framework.configuration.modes import MODES, sets_nothing
from framework.configuration.paths import flat, require_said, without_paths
from framework.configuration.registry import load
from framework.configuration.schema import resolve
from framework.configuration.settings import Settings, device_of
from framework.data import Batch, Data, Mapped
from framework.datasets.fields import fetched
from framework.density_head import Fitted
from framework.distributions.noise import seed_step
from framework.errors import CheckpointError, ConfigError, UserError
from framework.evaluation.splits import BLOCK, numbers, on_device, require_own
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
from framework.training.batches import Batches, require_targets, told
from framework.training.checkpoint import WholeCheckpoints, trained
from framework.uncertainty import remarks

FEW = 8
"""With so many validation samples wrappers are tried before training: some want more than one."""
M_TRIM_THRESHOLD, M_MMAP_THRESHOLD = -1, -3  # of malloc.h


@dataclass
class Session:
    """What a mode works with.

    Attributes:
        config: of the command; of a test the settings that make its numbers are those of the model's own run.
        parts: every plugin with every parameter, as they were built.
        method: what tables call the model.
        target: what is predicted.
        data: prepared, unless only a user's own files are read.
        predictor: untrained, or as loaded.
        device: where the predictor is evaluated.
        console: for people; says nothing in ranks other than the first.
        objectives: of the training loss.
        metrics: fresh, in the order asked for; none before `tested`.
        outliers: prepared, where a metric reads them; None before `tested`.
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
        return self.config.settings

    @property
    def data_title(self) -> str:
        """What pictures and tables call the data."""
        data = self.data
        return data.title or (data.groups[0] if len(data.groups) == 1 else self.parts["data"]["name"])

    @property
    def title(self) -> str:
        """What pictures and tables call the data and the model."""
        return f"{self.data_title} · {self.method}"

    def batches(self, data: Data | None = None) -> Batches:
        """Of the session's data, or of what stands in for them, as they are trained on."""
        chosen = self.settings
        return Batches(
            data or self.data, batch_size=chosen.batch_size, workers=chosen.workers, seed=chosen.seed
        )

    def blocks(self) -> Batches:
        """The session's data as they are evaluated: in blocks of one size, whatever the batch size is."""
        return Batches(self.data, batch_size=BLOCK, workers=self.settings.workers, seed=self.settings.seed)

    def description(self) -> dict[str, Any]:
        """What a checkpoint holds beside the weights."""
        remarks_now = remarks(self.predictor)
        return Description.of(self.parts, self.data, self.method, self.settings, remarks_now).stored()

    def record(self, run: Run) -> None:
        """Tell the run what it is fed, and leave what to cite with it."""
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
        """Leave weights and description with the run, for `framework.load`; in the store they are its model."""
        path = run.checkpoints / "model.ckpt"
        state = {f"{PREFIX}{key}": value.cpu() for key, value in self.predictor.state_dict().items()}
        WholeCheckpoints().save_checkpoint({"framework": self.description(), "state_dict": state}, path)
        run.tracker.log_artifact(path, MODEL)


def record_citations(run: Run, parts: Resolved) -> None:
    """Write what to cite into the run folder and the store."""
    path = run.folder / "citations.bib"
    if first_rank():
        path.write_text("\n\n".join(entries(citations(parts).values()).values()) + "\n", encoding="utf-8")
    run.tracker.log_artifact(path)


def begin(settings: Settings) -> Console:
    """Set this process up: threads, memory, what Lightning prints. Where to print."""
    if settings.threads:
        torch.set_num_threads(settings.threads)
    keep_memory()
    quiet()
    return output()


def for_training(config: Config) -> Session:
    """Everything built from the config; the data prepared, the metrics tried on a prediction.

    Raises:
        ConfigError: a part is missing or does not fit another.
        DataError: as `Data.prepare`.
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
        resumed and trained(config.folder / "checkpoints")
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
    """Refuse outliers that the command chooses and no metric reads.

    Raises:
        ConfigError: that is so.
    """
    given = config.given("outliers")
    if given and not reading_outliers(parts):
        refuse_idle(config.folder, sets_nothing(given, "no metric of this run reads outliers"))


def _refuse_training(config: Config, why: str) -> None:
    """Refuse what the command says of training by gradient, where there is none.

    Raises:
        ConfigError: it says something.
    """
    for group in ("optimizer", "trainer"):
        given = config.given(group)
        if given:
            refuse_idle(config.folder, sets_nothing(given, why))


@dataclass(frozen=True)
class Start:
    """The weights of an earlier run, from which training starts.

    Attributes:
        path: of the checkpoint.
        state: its weights.
        predictor: a model with these weights; None where the checkpoint describes none.
        about: target, shape of an input and its columns, for which that was built.
    """

    path: Path
    state: Mapping[str, torch.Tensor]
    predictor: Predictor | None = None
    about: tuple[Target, tuple[int, ...], tuple[str, ...]] | None = None

    @classmethod
    def of(cls, parts: Resolved, data: Data, settings: Settings) -> "Start":
        """Compare the model with the one whose weights it starts from, before data is read or generated.

        It is built for the target and the inputs that the checkpoint describes, unless the data set knows its own
        target already; `predictor_for` compares it with the data as they are.

        Raises:
            CheckpointError: there is no checkpoint, or it is another model's.
        """
        path = find_checkpoint(str(settings.checkpoint), uri=settings.logger.uri)
        content = read(path)
        state, described = weights(content), content.get("framework")
        if not isinstance(described, Mapping):  # `predictor_for` says what is wrong with the weights
            return cls(path, state)
        stored, shape, columns = interface(described, path)
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
        """Return the predictor with the weights; the one that was built where prepared data are as was described.

        Raises:
            CheckpointError: the weights are another model's.
        """
        if self.predictor is not None and self.about == (data.target, data.input_shape, data.columns):
            return self.predictor
        predictor = build_predictor(parts, data.target, data.input_shape, seed, columns=data.columns)
        fill(predictor, self.state, str(self.path))
        return predictor


def method_of(config: Config, parts: Resolved) -> str:
    """What tables call a model: its experiment, which stands for its own wrappers, or its head; then other wrappers."""
    name = config.settings.experiment_name
    method = name.rpartition("/")[2] if name else str(parts["density_head"]["name"])
    changed = any(item.lstrip("+~").startswith("uncertainty") for item in config.overrides)
    wrappers = [part["name"] for part in parts["uncertainty"]] if changed or not name else []
    return " + ".join([method, *wrappers])


def tested(session: Session) -> Session:
    """The session with what a test reads: fresh metrics, and the outliers of those that want some.

    Raises:
        ConfigError: a metric does not fit the target, or wants outliers and there are none.
        DataError: as `Data.prepare`.
    """
    parts = session.parts
    # those of a checkpoint are checked where they are used: a model predicts without them
    parts = {**parts, "metric": [resolve("metric", part) for part in parts["metric"]]}
    require_outliers(parts)
    metrics = build_metrics(parts, session.target)
    owners: dict[str, Metric] = {}
    for metric in metrics:
        for name in metric.columns:
            require_own(owners, name, metric)
    return replace(session, parts=parts, metrics=metrics, outliers=build_outliers(parts, session.data))


@torch.no_grad()
def rehearse(session: Session) -> None:
    """Whatever can go wrong without training goes wrong now: look at a few targets, give every metric predictions of
    two samples by the untrained model, calibrate a copy of it. Of a model that predicts nothing before it is fitted,
    look whether the true images are there.

    Raises:
        UserError: what the data, the metric or the wrapper says.
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
    if session.outliers is not None:  # as outliers some test samples do
        predictions.append(Prediction(density, some, samples, "outliers"))
    # what is said of so few samples means nothing
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
    """The first samples."""
    return fetched(dataset, range(min(most, len(dataset))))  # type: ignore[arg-type]


@contextmanager
def _silence() -> Iterator[None]:
    """Neither warnings nor what is logged below an error."""
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(before)


def for_trained(config: Config, *, prepare: bool = True) -> Session:
    """The model of `checkpoint`, with the data, outliers and metrics that the command line names, or else its own.

    Without `prepare` the data can only read a user's own files: nothing is generated or loaded for that.

    Raises:
        ConfigError: no checkpoint is named.
        CheckpointError: there is none, or the data does not fit the model.
    """
    console = begin(config.settings)
    if config.settings.checkpoint is None:
        raise ConfigError(
            f"mode={config.mode} needs checkpoint=<run folder, checkpoint file or MLflow run id>."
        )
    predictor, description = load_with_description(
        config.settings.checkpoint, uri=config.settings.logger.uri, paths=flat(config.settings.stored)
    )
    return around(config, predictor, description, console, prepare=prepare)


def around(
    config: Config, predictor: Predictor, description: Description, console: Console, *, prepare: bool = True
) -> Session:
    """The session of a predictor that is there already and described by a checkpoint; see `for_trained`.

    Raises:
        ConfigError: `prepare`, and a path of the stored data, outliers or metrics is not said again.
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
        key: value for key, value in flat(config.settings.stored).items() if key.partition(".")[0] in used
    }
    used, dropped = without_paths(used, again)
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
        outliers = "outliers" in {*reads} - chosen and bool(reading_outliers(parts))
        groups = ["data", *["metric"] * ("metric" in reads), *["outliers"] * outliers]
        require_said(dropped, groups, description.path)
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
    """Read a user's own files by a data set that the command chose or changed.

    Args:
        read: of the data set.
        data: the data set.
        description: of the model.
        config: of the command; None for a run that goes on, whose settings are not looked at again.
        files: the user's.

    Raises:
        CheckpointError: the first sample is of another shape than the model reads.
        ConfigError: the first files are read the same as the model reads them by itself.
    """
    samples = read(files)
    found, wanted = tuple(fetched(samples, range(1))["input"].shape[1:]), description.input_shape
    free = len(wanted) == 2  # clouds have any number of points
    if found[free:] != wanted[free:] or len(found) != len(wanted):
        raise CheckpointError(
            f"{description.path} reads inputs of shape {wanted}, but with data={description.config['data']['name']} as "
            f"this command sets it {files[0]} is one of shape {found}. Leave data out: the model knows its own."
        )
    given = None if config is None else config.given("data")
    if config is not None and given is not None and not isinstance(data, Mapped):
        skips = any(
            "unreadable=" in item for item in config.overrides
        )  # which the mode reads, not the data set
        some = list(files[:FEW])
        if not skips and _same_samples(_by_itself(description, some), read(some)):
            refuse_idle(config.folder, sets_nothing(given, f"the model reads {files[0]} the same without it"))
    return samples


def _by_itself(description: Description, files: Sequence[Path]) -> Dataset[Batch] | None:
    """Return the samples of files as a model reads them without anything that the command says of its data."""
    stored = read(Path(description.path))["framework"]["config"]["data"]
    try:
        config, _ = without_paths({"data": stored}, {})
        return reader(replace(description, config={**description.config, **config}, dropped={})).read(files)
    except UserError:  # without a path that the command says, for one
        return None


def _same_samples(one: Dataset[Batch] | None, other: Dataset[Batch]) -> bool:
    if one is None or len(one) != len(other):  # type: ignore[arg-type]
        return False
    first, second = (fetched(each, range(min(BLOCK, len(each)))) for each in (one, other))  # type: ignore[arg-type]
    return first.keys() == second.keys() and all(torch.equal(first[key], second[key]) for key in first)


def inherited(config: Config, description: Description) -> Config:
    """The config with the settings of the model's own run, but for those that the command line gives."""
    given = {item.lstrip("+~").partition("=")[0] for item in config.overrides}
    kept = {
        key: value for key, value in description.settings.items() if key.removesuffix("_name") not in given
    }
    return replace(config, values={**config.values, **kept}, settings=config.settings.model_copy(update=kept))


def require_fit(data: Data, description: Description) -> None:
    """Refuse data that the model was not made for.

    Raises:
        CheckpointError: inputs of another shape, or other targets.
    """
    target = description.target
    wanted = description.input_shape, target.kind, target.names, target.size
    found = data.input_shape, data.target.kind, data.target.names, data.target.size
    if wanted != found:
        raise CheckpointError(
            f"{description.path} reads inputs of shape {wanted[0]} and predicts {wanted[1]} ({target.told}), but the "
            f"data has inputs of shape {found[0]} and targets {found[1]} ({data.target.told}). Give the data it was "
            "trained on."
        )


def require_target(target: Target | None, description: Description) -> None:
    """Refuse data that is known, before it is read or generated, to have other targets than the model.

    Raises:
        CheckpointError: it has.
    """
    wanted = description.target
    if target is not None and (target.kind, target.names, target.size) != (
        wanted.kind,
        wanted.names,
        wanted.size,
    ):
        raise CheckpointError(
            f"{description.path} predicts {wanted.kind} ({wanted.told}), but the data has targets {target.kind} "
            f"({target.told}). Give the data it was trained on."
        )


def calibrate(session: Session) -> None:
    """Fit what is not trained by gradient, on the validation set."""
    session.predictor.eval().to(session.device)
    seed_step(session.settings.seed, 0, "calibrate")
    batches = told(session.blocks().val_dataloader(), "calibrating")
    session.predictor.calibrate(on_device(batches, session.device))
    for remark in remarks(session.predictor):
        session.console.print(remark, soft_wrap=True, highlight=False, markup=False)


def keep_memory() -> None:
    """Let glibc keep freed memory: a training step frees and asks for the same megabytes again and again.

    Without it each step pays for thousands of page faults, a quarter of a small network's time. Elsewhere than on
    glibc nothing happens.
    """
    if platform.libc_ver()[0] == "glibc":
        library = ctypes.CDLL(None)
        library.mallopt(M_MMAP_THRESHOLD, 1 << 30)
        library.mallopt(M_TRIM_THRESHOLD, 2**31 - 1)


def quiet() -> None:
    """Lightning's notices about hardware it did not find, and a deprecation inside it, tell our user nothing."""
    for name in ("pytorch_lightning", "lightning_fabric"):
        logging.getLogger(name).setLevel(logging.ERROR)
    warnings.filterwarnings("ignore", message=".*LeafSpec", module="pytorch_lightning")
    warnings.filterwarnings("ignore", message=".*does not have many workers", module="pytorch_lightning")
    # a machine of a cluster, on which nobody asked for SLURM
    warnings.filterwarnings("ignore", message="The `srun` command is available on your system")
    # ours is resumable, by another way than the one Lightning looks for
    warnings.filterwarnings(
        "ignore", message=".*your dataloader is not resumable", module="pytorch_lightning"
    )
