"""Run in an MLflow store; this module imports MLflow, so it is imported only when a store is opened."""

import getpass
import hashlib
import json
import logging
import os
import platform
import re
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import final

from framework.errors import CheckpointError, DataError, escape_undecodable, shorten
from framework.storage.cache import folder as cache_folder
from framework.storage.enclosed import require_enclosed, require_plain_within
from framework.storage.files import hold_lock, remove_leftovers, replacing
from framework.storage.names import path_of, spell_name
from framework.tracking.run_info import MODEL, RunInfo, read_run_info
from framework.tracking.sender import Record, Store, reason
from framework.tracking.stores import address, require_own_files, sqlite_path, sqlite_uri, without_password

os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
# One retry instead of minutes of retries: the caller tries again itself, and must notice when it is told to end.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # MLflow warns about its own dependencies
    from mlflow import MlflowClient, artifacts
    from mlflow.entities import Dataset, DatasetInput, InputTag, LoggedModelOutput, Metric, Param, Run, RunTag
    from mlflow.exceptions import MlflowException
    from mlflow.models import Model
    from mlflow.store.tracking.sqlalchemy_store import SqlAlchemyStore

_log = logging.getLogger(__name__)
logging.getLogger("alembic").setLevel(logging.WARNING)
logging.getLogger("mlflow").setLevel(logging.WARNING)
# These loggers report each failed attempt at length; the sender reports the failure once.
logging.getLogger("mlflow.store.db.utils").setLevel(logging.CRITICAL)
logging.getLogger("urllib3.connectionpool").setLevel(logging.ERROR)

_KEY, _FOLDER = "framework.key", "framework.folder"  # tags
_LONGEST_NAME = 250  # characters
_DIGEST = 16  # characters of a digest that MLflow shows
_LOADER = "framework.deployment.served"
"""Module by which MLflow loads a model; it is a constant because a run folder may come from an untrusted source."""


@final
class MlflowStore(Store):
    """Run in an MLflow store; it is created there if it does not exist.

    Args:
        folder: Folder of the run.
        info: Description of the run. The run is searched by its id first, then by its key. If the status is RUNNING,
            it is set in MLflow too.

    Raises:
        Exception: MLflow, SQLAlchemy and the network raise various kinds when the store is locked, full or cannot be
            reached.
    """

    def __init__(self, folder: Path, info: RunInfo) -> None:
        self._folder, self._info = folder, info
        self._client, experiment_id = _opened(info)
        run = self._found(info, experiment_id)
        self.replay = {"replay_after": info.replay_after, "replay_until": info.replay_until}
        sent, owed = info.sent, info.owed
        if run is None:
            run = self._created(info, experiment_id)
            sent, owed, self.replay = 0, (), {"replay_after": None, "replay_until": {}}
        elif run.info.lifecycle_stage == "deleted":
            raise RuntimeError(f"run {run.info.run_id} was deleted there; restore it in MLflow")
        elif info.status == "RUNNING":
            self._client.update_run(run.info.run_id, status="RUNNING")
            self._client.set_tag(
                run.info.run_id, _FOLDER, spell_name(folder)
            )  # the folder may have been moved
        self.identity = {
            "run_id": run.info.run_id,
            "experiment_id": run.info.experiment_id,
            "sent": sent,
            "owed": owed,
            **self.replay,
        }
        self._run_id: str = run.info.run_id
        self._experiment_id: str = run.info.experiment_id
        self._files: str | None = run.info.artifact_uri
        self._model_name = re.sub(r"[^\w-]", "_", info.run_name.partition(",")[0])[:_LONGEST_NAME] or "model"
        self._params: dict[str, str] = dict(run.data.params)
        # The last step of each metric; RunData itself holds only the values.
        self._stored = {metric.key: metric.step for metric in run.to_proto().data.metrics}
        self._renamed: set[str] = set()

    def _require_own_files(self, location: str | None) -> None:
        """Refuse to write files outside the folder of a store that the user did not name."""
        if not self._info.named:
            require_own_files(self._info.uri, (location or "",))

    def send(self, batch: Sequence[Record]) -> None:
        """Store a batch; SQL stores identify a metric by key, time, step and value, so a repeated one is kept once."""
        if "status" in batch[0]:
            status, end = batch[0]["status"], round(batch[0]["time"] * 1000)
            if status == "RUNNING":
                self._client.update_run(self._run_id, status=status)
            else:
                self._client.set_terminated(self._run_id, status, end)
        elif "resumed_after" in batch[0]:
            self.replay = {"replay_after": batch[0]["resumed_after"], "replay_until": dict(self._stored)}
        elif "dataset" in batch[0]:
            self._client.log_inputs(self._run_id, [_dataset(batch[0])])
        else:
            metrics = [metric for record in batch for metric in self._metrics(record)]
            params, tags, removed = self._params_and_tags(batch)
            self._log(metrics, params, tags)
            for key in removed:
                self._remove_tag(key)
            for metric in metrics:
                self._stored[metric.key] = max(metric.step, self._stored.get(metric.key, metric.step))
            self._params |= {param.key: param.value for param in params}

    def send_file(self, path: str, place: str) -> None:
        """Store a file or directory; one that is missing or leads out of the run folder is skipped with a warning."""
        file = self._folder / path
        # a journal may come from an untrusted source, so files outside the run folder must not be sent
        try:
            if not file.is_relative_to(self._folder) or ".." in file.parts:
                raise DataError("it names a file elsewhere")
            require_plain_within(file, self._folder)
            if file.is_dir():
                require_enclosed(file)
        except DataError as error:
            _log.warning(
                "%s leads out of the run folder %s (%s): it is not sent.", shorten(file), self._folder, error
            )
            return
        self._require_own_files(self._files)
        if place == MODEL and file.is_file():
            self._send_model(file)
        elif file.is_dir():
            self._client.log_artifacts(
                self._run_id, str(file), f"{place}/{file.name}" if place else file.name
            )
        elif file.exists():
            self._client.log_artifact(self._run_id, str(file), place or None)
        else:
            _log.warning("%s is gone before it could be stored.", shorten(file))

    def _send_model(self, file: Path) -> None:
        """Store the checkpoint as a model that MLflow can serve; it replaces a model sent before."""
        found = self._client.search_logged_models(
            [self._experiment_id], f"source_run_id = '{self._run_id}'", max_results=1
        )
        model = found[0] if found else None
        if model is None:
            model = self._client.create_logged_model(self._experiment_id, self._model_name, self._run_id)
        self._require_own_files(model.artifact_location)
        described = Model(run_id=self._run_id, model_id=model.model_id)
        described.add_flavor(
            "python_function", loader_module=_LOADER, data=file.name, python_version=platform.python_version()
        )
        with TemporaryDirectory() as folder:
            described.save(str(Path(folder) / "MLmodel"))
            self._client.log_model_artifact(model.model_id, str(Path(folder) / "MLmodel"))
        self._client.log_model_artifact(model.model_id, str(file))
        self._client.finalize_logged_model(model.model_id, "READY")
        if model.model_id not in _models(self._client.get_run(self._run_id)):
            self._client.log_outputs(self._run_id, [LoggedModelOutput(model.model_id, 0)])

    def _found(self, info: RunInfo, experiment_id: str) -> Run | None:
        if info.run_id is not None:
            try:
                run = self._client.get_run(info.run_id)
                # the id in a file may belong to another run of the user
                if run.data.tags.get(_KEY, info.key) == info.key:
                    return run
            except MlflowException as error:
                if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                    raise
            uri = without_password(info.uri)
            _log.warning(
                "%s knows no run %s: the run is stored there anew.", shorten(uri), shorten(info.run_id)
            )
        found = self._client.search_runs([experiment_id], f"tags.`{_KEY}` = '{info.key}'", max_results=1)
        return found[0] if found else None

    def _created(self, info: RunInfo, experiment_id: str) -> Run:
        tags = {_KEY: info.key, _FOLDER: spell_name(self._folder), "mlflow.user": _user()}
        tags |= {"mlflow.source.name": "python -m framework", "mlflow.source.type": "LOCAL"}
        if info.parent:
            tags["mlflow.parentRunId"] = info.parent
        return self._client.create_run(
            experiment_id, int(info.started * 1000), tags, escape_undecodable(info.run_name)
        )

    def _metrics(self, record: Record) -> Iterator[Metric]:
        after, until = self.replay["replay_after"], self.replay["replay_until"]
        for name, value in record.get("values", {}).items():
            key, step = self._name(name), record["step"]
            if after is None or not after < step <= until.get(key, after):
                yield Metric(key, float(value), round(record["time"] * 1000), step)

    def _params_and_tags(self, batch: Sequence[Record]) -> tuple[list[Param], list[RunTag], list[str]]:
        """Return parameters, tags, and the keys of tags that were removed."""
        params: dict[str, str] = {}
        tags: dict[str, str | None] = {}
        for record in batch:
            tags |= {
                self._name(key): value and escape_undecodable(value)
                for key, value in record.get("tags", {}).items()
            }
            for name, value in record.get("params", {}).items():
                key, value = self._name(name), escape_undecodable(value)
                before = self._params.get(key, params.get(key))
                if before is None:
                    params[key] = value
                elif before != value:  # MLflow lets no parameter change, so the new value becomes a tag
                    tags[f"changed.{key}"[:_LONGEST_NAME]] = value
        texts = [RunTag(key, value) for key, value in tags.items() if value is not None]
        removed = [key for key, value in tags.items() if value is None]
        return [Param(*item) for item in params.items()], texts, removed

    def _remove_tag(self, key: str) -> None:
        try:
            self._client.delete_tag(self._run_id, key)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":  # it was never sent
                raise

    def _log(self, metrics: Sequence[Metric], params: Sequence[Param], tags: Sequence[RunTag]) -> None:
        if not (metrics or params or tags):
            return
        try:
            self._client.log_batch(self._run_id, metrics, params, tags, synchronous=True)
        except MlflowException as error:
            deleted = self._client.get_run(self._run_id).info.lifecycle_stage == "deleted"
            if error.error_code != "INVALID_PARAMETER_VALUE" or deleted:
                raise
            # One entry is refused permanently. Find it, so that the entries behind it do not wait for ever.
            singles = [([entry], [], []) for entry in metrics]
            singles += [([], [entry], []) for entry in params] + [([], [], [entry]) for entry in tags]
            for single in singles:
                try:
                    self._client.log_batch(self._run_id, *single, synchronous=True)
                except MlflowException as fault:
                    if fault.error_code != "INVALID_PARAMETER_VALUE":
                        raise
                    _log.warning("MLflow refuses an entry; the journal keeps it: %s", reason(fault))

    def _name(self, name: str) -> str:
        parts = re.sub(r"[^/\w.\- :]", "_", name)[:_LONGEST_NAME].split("/")
        key = "/".join(part for part in parts if part not in ("", ".", "..")) or "_"
        if key != name and name not in self._renamed:
            self._renamed.add(name)
            _log.warning("MLflow takes no name like %r; there it is %r.", name, key)
        return key


def _dataset(record: Record) -> DatasetInput:
    """Return the content of MLflow's column `Dataset`: name, digest, and all facts about the data as the profile."""
    facts: dict[str, str] = {key: escape_undecodable(fact) for key, fact in record["facts"].items()}
    digest = facts.get("sha256") or hashlib.sha256(json.dumps(facts, sort_keys=True).encode()).hexdigest()
    dataset = Dataset(
        escape_undecodable(record["dataset"]),
        digest[:_DIGEST],
        source_type="local",
        source=json.dumps({"root": facts.get("root", "")}),
        profile=json.dumps(facts),
    )
    return DatasetInput(dataset, [InputTag("mlflow.data.context", record["context"])])


def _models(run: Run) -> list[str]:
    return [output.model_id for output in run.outputs.model_outputs] if run.outputs else []


def run_folder(run_id: str, uri: str | None = None) -> Path:
    """Return the folder in which a run was made, or else a copy of its stored checkpoints in the cache.

    Args:
        run_id: Id of the run in MLflow.
        uri: Address of the store; None means outputs/mlflow.db in the working directory.

    Raises:
        CheckpointError: The store has no such run, or the run has no checkpoints.
    """
    store = address(uri, Path.cwd() / "outputs" / "any")
    told = without_password(store.uri)
    path = sqlite_path(store.uri)
    if path is not None and not path.is_file():  # MLflow would create the file
        raise CheckpointError(f"There is no tracking store {path}. Give its address (logger.uri=...).")
    if not store.named:
        require_own_files(store.uri)
    client = MlflowClient(tracking_uri=store.uri)
    try:
        run = client.get_run(run_id)
        made = path_of(run.data.tags.get(_FOLDER, ""))
        # a store that the user did not name may have come with a run folder, so it is trusted for its own folder only
        trusted = store.named or (path is not None and made.resolve().is_relative_to(path.parent.resolve()))
        if _FOLDER in run.data.tags and trusted and _holds(made, run_id):
            return made
        if not store.named:
            require_own_files(store.uri, (run.info.artifact_uri or "",))
        models = _models(run)
        if not models and not client.list_artifacts(run_id, "checkpoints"):
            raise CheckpointError(
                f"Run {run_id} of {told} has no checkpoints, and its folder {made} is gone."
            )
        copy = cache_folder("runs") / run_id
        copy.mkdir(exist_ok=True)
        if models:
            # an address "models:/" would ask another store
            place = client.get_logged_model(models[0]).artifact_location
            if not store.named:
                require_own_files(store.uri, (place or "",))
            return Path(artifacts.download_artifacts(place, dst_path=str(copy), tracking_uri=store.uri))
        # runs of version 0.1 keep checkpoints as files
        client.download_artifacts(run_id, "checkpoints", str(copy))
    except MlflowException as error:
        raise CheckpointError(f"Run {run_id} cannot be had from {told}: {reason(error)}.") from error
    return copy


def _holds(folder: Path, run_id: str) -> bool:
    """Return whether a folder still holds the run with this id; another run may have been made there since."""
    try:
        info = read_run_info(folder)
    except DataError:
        return False
    return info is not None and info.run_id == run_id


def _opened(info: RunInfo) -> tuple[MlflowClient, str]:
    """Return a client of the run's store and the id of the run's experiment; both are created if missing."""
    path = sqlite_path(info.uri)
    if path is None:
        client = MlflowClient(tracking_uri=info.uri)
        return client, _experiment(client, info)
    path.parent.mkdir(parents=True, exist_ok=True)
    if not info.named:
        require_own_files(info.uri)
    # MLflow's own migrations and get-or-create fail when several processes begin at the same time.
    with hold_lock(path.with_name(f".{path.name}.lock")):
        if not path.exists() or path.stat().st_size == 0:
            _make_database(path, info)
        client = MlflowClient(tracking_uri=info.uri)
        return client, _experiment(client, info)


def _make_database(path: Path, info: RunInfo) -> None:
    """Create an SQLite store under a temporary name and rename it, since MLflow cannot repair an incomplete one."""
    remove_leftovers(path.parent)
    with replacing(path) as partial:
        SqlAlchemyStore(sqlite_uri(partial), info.artifacts).engine.dispose()
    # MLflow caches connections by address; a cached one may lead to a deleted file of the same name.
    SqlAlchemyStore(info.uri, info.artifacts).engine.dispose()


def _experiment(client: MlflowClient, info: RunInfo) -> str:
    found = client.get_experiment_by_name(info.experiment)
    if found is None:
        try:
            made = client.create_experiment(info.experiment, artifact_location=info.artifacts)
            for key, value in _view(made).items():
                client.set_experiment_tag(made, key, value)
            return made
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        found = client.get_experiment_by_name(info.experiment)  # another process created it first
    if found is None or found.lifecycle_stage == "deleted":
        raise RuntimeError(
            f"experiment {info.experiment!r} was deleted there; restore it, or choose another name"
        )
    return found.experiment_id


def _view(experiment_id: str) -> dict[str, str]:
    """Return tags of an experiment: a view that shows both losses in one chart, and a link to it as the description.

    MLflow itself draws each metric in a separate chart. A view is the object that its button `Share` creates.
    """
    losses = ["train/loss", "validation/loss"]
    chart = {"uuid": "losses", "metricSectionId": "losses", "type": "LINE", "metricKey": losses[0]}
    chart |= {"selectedMetricKeys": losses, "deleted": False, "isGenerated": False, "lineSmoothness": 0}
    section = {"uuid": "losses", "name": "Losses", "display": True, "isReordered": False}
    view = {"compareRunCharts": [chart], "compareRunSections": [section], "isAccordionReordered": True}
    link = f"#/experiments/{experiment_id}/runs?viewStateShareKey=losses&compareRunsMode=CHART"
    return {
        "mlflow.sharedViewState.losses": json.dumps(view),
        "mlflow.note.content": f"[Training and validation loss in one chart]({link})",
    }


def _user() -> str:
    try:
        return getpass.getuser()
    except (KeyError, OSError):  # the user of a container may have no name
        return "unknown"
