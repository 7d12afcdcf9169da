"""Access to a run in an MLflow store; this module imports MLflow, so it is imported only when a store is opened."""

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
from framework.storage.old_versions import download_checkpoint_files, has_checkpoint_files
from framework.tracking.run_info import MODEL, RunInfo, read_run_info
from framework.tracking.sender import Record, Store, reason
from framework.tracking.stores import address, require_own_files, sqlite_path, sqlite_uri, without_password

os.environ["MLFLOW_DISABLE_TELEMETRY"] = "true"
# One retry instead of minutes of retries: the caller tries again, and must notice in between that it has to end.
os.environ.setdefault("MLFLOW_HTTP_REQUEST_MAX_RETRIES", "1")
# The framework prints the address of the run itself, without a password.
os.environ.setdefault("MLFLOW_SUPPRESS_PRINTING_URL_TO_STDOUT", "true")
with warnings.catch_warnings():
    warnings.simplefilter("ignore", DeprecationWarning)  # MLflow warns about its own dependencies
    from mlflow import MlflowClient, artifacts
    from mlflow.entities import Dataset, DatasetInput, InputTag, LoggedModelOutput, Metric, Param, Run, RunTag
    from mlflow.exceptions import MlflowException
    from mlflow.models import Model
    from mlflow.store.artifact.local_artifact_repo import LocalArtifactRepository
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
"""Module with which MLflow loads a model; a constant, because a run folder may come from an untrusted source."""


@final
class MlflowStore(Store):
    """Run in an MLflow store; the run is created if the store does not contain it.

    Args:
        folder: Folder of the run.
        info: Content of `run.json`. The run is searched in the store by its id first, then by its key. If the status
            in `info` is RUNNING, the status of an existing run in MLflow is set to RUNNING too.

    Raises:
        Exception: MLflow, SQLAlchemy and the network raise errors of many classes when the store is locked, full or
            cannot be reached.
    """

    def __init__(self, folder: Path, info: RunInfo) -> None:
        self._folder, self._info = folder, info
        self._client, experiment_id = _open_client(info)
        run = self._find_run(info, experiment_id)
        self.replay = {"replay_after": info.replay_after, "replay_until": info.replay_until}
        sent, owed = info.sent, info.owed
        if run is None:
            run = self._create_run(info, experiment_id)
            sent, owed, self.replay = 0, (), {"replay_after": None, "replay_until": {}}
        elif run.info.lifecycle_stage == "deleted":
            raise RuntimeError(f"run {run.info.run_id} was deleted in the store; restore the run in MLflow")
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
        # The last step of each metric; RunData contains only the values.
        self._stored = {metric.key: metric.step for metric in run.to_proto().data.metrics}
        self._renamed: set[str] = set()

    def _own_folder(self, location: str | None) -> LocalArtifactRepository | None:
        """Return the folder for files of a store that the user did not name; None for a store that the user named.

        For the latter, MLflow's client finds the folder. It reads the location from the store again, and the database
        of another person may then state another location, for example after a trigger.

        Raises:
            DataError: The location lies outside the folder of the store.
        """
        if self._info.named:
            return None
        require_own_files(self._info.uri, (location or "",))
        return LocalArtifactRepository(location or "")

    def send(self, batch: Sequence[Record]) -> None:
        """Store a batch; MLflow ignores a metric that it has already, with the same key, time, step and value."""
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
        """Store the file or directory `path` of the run folder under the folder `place` of the run in the store.

        If it is missing or leads out of the run folder, it is skipped with a warning.
        """
        file = self._folder / path
        # a journal may come from an untrusted source, so files outside the run folder must not be sent
        try:
            if not file.is_relative_to(self._folder) or ".." in file.parts:
                raise DataError("the path contains `..`, or begins outside of the folder")
            require_plain_within(file, self._folder)
            if file.is_dir():
                require_enclosed(file)
        except DataError as error:
            _log.warning(
                "%s leads out of the run folder %s (%s), so the file is not sent.",
                shorten(file),
                self._folder,
                error,
            )
            return
        own, within = self._own_folder(self._files), f"{place}/{file.name}" if place else file.name
        if place == MODEL and file.is_file():
            self._send_model(file)
        elif file.is_dir() and own is not None:
            own.log_artifacts(str(file), within)
        elif file.is_dir():
            self._client.log_artifacts(self._run_id, str(file), within)
        elif file.exists() and own is not None:
            own.log_artifact(str(file), place or None)
        elif file.exists():
            self._client.log_artifact(self._run_id, str(file), place or None)
        else:
            _log.warning("%s was removed before it could be sent to the store.", shorten(file))

    def _send_model(self, file: Path) -> None:
        """Store a checkpoint as the run's model, which MLflow can serve; it replaces a model that was sent before."""
        models = self._client.search_logged_models(
            [self._experiment_id], f"source_run_id = '{self._run_id}'", max_results=1
        )
        model = models[0] if models else None
        if model is None:
            model = self._client.create_logged_model(self._experiment_id, self._model_name, self._run_id)
        own = self._own_folder(model.artifact_location)
        description = Model(run_id=self._run_id, model_id=model.model_id)
        description.add_flavor(
            "python_function", loader_module=_LOADER, data=file.name, python_version=platform.python_version()
        )
        with TemporaryDirectory() as folder:
            description.save(str(Path(folder) / "MLmodel"))
            for part in (Path(folder) / "MLmodel", file):
                if own is None:
                    self._client.log_model_artifact(model.model_id, str(part))
                else:
                    own.log_artifact(str(part))
        self._client.finalize_logged_model(model.model_id, "READY")
        if model.model_id not in _models(self._client.get_run(self._run_id)):
            self._client.log_outputs(self._run_id, [LoggedModelOutput(model.model_id, 0)])

    def _find_run(self, info: RunInfo, experiment_id: str) -> Run | None:
        if info.run_id is not None:
            try:
                run = self._client.get_run(info.run_id)
                # the id in a file may belong to another run of the user, also of another program
                if run.data.tags.get(_KEY) == info.key:
                    return run
            except MlflowException as error:
                if error.error_code != "RESOURCE_DOES_NOT_EXIST":
                    raise
            uri = without_password(info.uri)
            _log.warning(
                "The store %s contains no run %s of this folder, so the whole run is sent again.",
                shorten(uri),
                shorten(info.run_id),
            )
        runs = self._client.search_runs([experiment_id], f"tags.`{_KEY}` = '{info.key}'", max_results=1)
        return runs[0] if runs else None

    def _create_run(self, info: RunInfo, experiment_id: str) -> Run:
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
        """Return the parameters and the tags to set that a batch contains, and the keys of the tags to remove."""
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
                elif before != value:  # MLflow refuses to change a parameter, so the new value becomes a tag
                    tags[f"changed.{key}"[:_LONGEST_NAME]] = value
        texts = [RunTag(key, value) for key, value in tags.items() if value is not None]
        removed = [key for key, value in tags.items() if value is None]
        return [Param(*item) for item in params.items()], texts, removed

    def _remove_tag(self, key: str) -> None:
        try:
            self._client.delete_tag(self._run_id, key)
        except MlflowException as error:
            if error.error_code != "RESOURCE_DOES_NOT_EXIST":  # the tag was never sent
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
            # MLflow always refuses one of the entries. Send the entries one by one, so that the others arrive.
            singles = [([entry], [], []) for entry in metrics]
            singles += [([], [entry], []) for entry in params] + [([], [], [entry]) for entry in tags]
            for single in singles:
                try:
                    self._client.log_batch(self._run_id, *single, synchronous=True)
                except MlflowException as fault:
                    if fault.error_code != "INVALID_PARAMETER_VALUE":
                        raise
                    _log.warning(
                        "MLflow refuses an entry, which only the journal contains now: %s", reason(fault)
                    )

    def _name(self, name: str) -> str:
        parts = re.sub(r"[^/\w.\- :]", "_", name)[:_LONGEST_NAME].split("/")
        key = "/".join(part for part in parts if part not in ("", ".", "..")) or "_"
        if key != name and name not in self._renamed:
            self._renamed.add(name)
            _log.warning("MLflow does not accept the name %r, so the store uses %r.", name, key)
        return key


def _dataset(record: Record) -> DatasetInput:
    """Return a data set for MLflow's column `Dataset`: name, digest, and all facts about the data as the profile."""
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
    """Return the folder of a run or, if the folder no longer exists, a folder in the cache with its checkpoints.

    Args:
        run_id: Id of the run in MLflow.
        uri: Address of the store; None means outputs/mlflow.db in the working directory.

    Raises:
        CheckpointError: The store has no such run, or the run has no checkpoints.
    """
    store = address(uri, Path.cwd() / "outputs" / "any")
    store_name = without_password(store.uri)
    path = sqlite_path(store.uri)
    if path is not None and not path.is_file():  # MLflow would create the file
        raise CheckpointError(
            f"There is no tracking store {path}. Give the address of the store with logger.uri=..."
        )
    if not store.named:
        require_own_files(store.uri)
    client = MlflowClient(tracking_uri=store.uri)
    try:
        run = client.get_run(run_id)
        original_folder = path_of(run.data.tags.get(_FOLDER, ""))
        # a store that the user did not name may have come with a run folder, so it is trusted for its own folder only
        trusted = store.named or (
            path is not None and original_folder.resolve().is_relative_to(path.parent.resolve())
        )
        if _FOLDER in run.data.tags and trusted and _contains_run(original_folder, run_id):
            return original_folder
        if not store.named:
            require_own_files(store.uri, (run.info.artifact_uri or "",))
        models = _models(run)
        if not models and not has_checkpoint_files(client, run_id):
            raise CheckpointError(
                f"Run {run_id} of {store_name} has no checkpoints, and its folder {original_folder} does not exist. "
                "Give another run, or the folder to which this run was moved."
            )
        copy = cache_folder("runs") / run_id
        copy.mkdir(exist_ok=True)
        if models:
            # the artifact location is used, because an address "models:/" would contact another store
            place = client.get_logged_model(models[0]).artifact_location
            if not store.named:
                require_own_files(store.uri, (place or "",))
            return Path(artifacts.download_artifacts(place, dst_path=str(copy), tracking_uri=store.uri))
        download_checkpoint_files(client, run_id, str(copy))
    except MlflowException as error:
        raise CheckpointError(
            f"Run {run_id} cannot be read from {store_name}: {reason(error)}. Check the id and the address of the "
            "store (logger.uri=...)."
        ) from error
    return copy


def _contains_run(folder: Path, run_id: str) -> bool:
    """Return whether a folder still contains the run `run_id`, and not another run that has replaced it."""
    try:
        info = read_run_info(folder)
    except DataError:
        return False
    return info is not None and info.run_id == run_id


def _open_client(info: RunInfo) -> tuple[MlflowClient, str]:
    """Return a client of the run's store and the id of the run's experiment; create them if they are missing."""
    path = sqlite_path(info.uri)
    if path is None:
        client = MlflowClient(tracking_uri=info.uri)
        try:
            return client, _experiment(client, info)
        except MlflowException as error:
            if error.error_code != "UNAUTHENTICATED":
                raise
        raise RuntimeError(  # after the block, because `reason` reports the first error of a chain
            "the server refuses the user name or the password, which MLFLOW_TRACKING_USERNAME and "
            "MLFLOW_TRACKING_PASSWORD give"
        )
    path.parent.mkdir(parents=True, exist_ok=True)
    if not info.named:
        require_own_files(info.uri)
    # MLflow fails to create a database or an experiment when several processes do so at the same time.
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
    experiment = client.get_experiment_by_name(info.experiment)
    if experiment is None:
        try:
            experiment_id = client.create_experiment(info.experiment, artifact_location=info.artifacts)
            for key, value in _chart_tags(experiment_id).items():
                client.set_experiment_tag(experiment_id, key, value)
            return experiment_id
        except MlflowException as error:
            if error.error_code != "RESOURCE_ALREADY_EXISTS":
                raise
        experiment = client.get_experiment_by_name(info.experiment)  # another process created it first
    if experiment is None or experiment.lifecycle_stage == "deleted":
        raise RuntimeError(
            f"experiment {info.experiment!r} was deleted in the store; restore the experiment, or choose another name"
        )
    return experiment.experiment_id


def _chart_tags(experiment_id: str) -> dict[str, str]:
    """Return tags of an experiment that give it a chart with both the training loss and the validation loss.

    By default, MLflow draws each metric in a separate chart. One tag is a view, as MLflow's button `Share` creates it;
    the other is a description of the experiment with a link to this view.
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
