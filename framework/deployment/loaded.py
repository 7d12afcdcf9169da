"""Loading of a trained model in Python (`framework.load`); with a budget, the model's knobs are set to meet it."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from framework.configuration import loading
from framework.configuration.assembly import build_metrics
from framework.configuration.description import Description
from framework.configuration.paths import remove_paths, require_paths
from framework.configuration.schema import check, resolve
from framework.configuration.settings import BudgetSettings, Settings
from framework.data import Data
from framework.errors import ConfigError
from framework.model import Predictor
from framework.prediction import Prediction


def load(
    run_or_checkpoint: str | Path,
    *,
    uri: str | None = None,
    paths: Mapping[str, Any] | None = None,
    budget: Mapping[str, Any] | None = None,
) -> Predictor:
    """Return the trained model in evaluation mode, on the CPU; the model reads the user's own data.

    `model(data)` returns the density over the target, with batch_shape (batch,). `data` are files, arrays or other
    data that the data set accepts (`Data.inputs`). Angles are in radians, and real-valued targets in the unit of the
    training data. A class is its index in `density.names`; for other targets, `density.names` are the names of the
    numbers. The other methods of the model take inputs in the form that the data set produces.

    Random numbers (latent variables, dropout, samples) come from torch's global generator, so `torch.manual_seed`
    before a call makes the call repeatable. Loading takes no random number from this generator. The weights require no
    gradient, so that NumPy, pandas and Matplotlib accept the results; call `model.requires_grad_()` to continue
    training.

    With a budget, such as `{"milliseconds": 5}`, the settings of the model that trade error for run time (samples,
    members, steps) are measured on this machine with the validation data of the run, and set to the cheapest values
    that meet the budget. `print(model)` then shows these values and the reason for them.

    Args:
        run_or_checkpoint: A run folder (`outputs/...`), a `.ckpt` file, or an MLflow run id.
        uri: Tracking store of the run id; the local store under `outputs/` by default.
        paths: Files and folders by their keys in the model's config, {"encoder.rasterised.body": "/my/body.npz"}. Paths
            in the checkpoint itself are never used, because it may come from an untrusted source.
        budget: One limit, and up to two options. The limit is either `milliseconds`, the largest run time per sample,
            or `error`, the largest error on the validation data. The run time is that of the density, the point
            prediction and the error. The option `metric` says which number of the model's metrics is the error. The
            option `batch_size` is the number of samples of a timed call, 1 by default.

    Raises:
        CheckpointError: There is no checkpoint, it is damaged, or its weights do not fit the model that it describes.
        ConfigError: The model needs a path that `paths` does not give; or the budget is invalid, the model has no such
            settings, or no setting meets the budget.
    """
    if budget is None:
        return loading.load(run_or_checkpoint, uri=uri, paths=paths)
    limits = BudgetSettings.model_validate(check(BudgetSettings, budget, "budget"))
    if not limits.limits:
        raise ConfigError("budget has no limit. Give milliseconds or error, such as {'milliseconds': 5}.")
    predictor, description = loading.load_with_description(run_or_checkpoint, uri=uri, paths=paths)
    return loading.for_user(predictor, apply_budget(predictor, description, limits, paths=paths))


def apply_budget(
    predictor: Predictor,
    description: Description,
    budget: BudgetSettings,
    *,
    paths: Mapping[str, Any] | None = None,
    data: Data | None = None,
    settings: Settings | None = None,
    batch_size: int = 1,
    work: Callable[[Prediction], object] = lambda prediction: prediction.point,
) -> Description:
    """Set the knobs of a stored model such that it meets a budget; return its description with the reason as a remark.

    Args:
        predictor: The model, as `load_with_description` returns it.
        description: Its description.
        budget: The limit.
        paths: Files and folders that the user repeats, by their keys in the model's config, as in `load`.
        data: Prepared data whose validation split is used; None prepares the data of the model.
        settings: Settings whose `samples` and `seed` are used; None: those of the model's run.
        batch_size: Number of samples in the timed batch, if `budget.batch_size` is None.
        work: Function that computes what the user needs from a prediction; its run time counts.

    Raises:
        ConfigError: The budget is invalid, the model has no knob, no setting meets the budget, or a path is not given.
    """
    from framework.evaluation.budget import meet_budget  # imports the metrics

    of_metrics = {key: value for key, value in (paths or {}).items() if key.startswith("metric.")}
    parts, dropped = remove_paths({"metric": description.config["metric"]}, of_metrics)
    require_paths(dropped, ("metric",), description.path)
    parts["metric"] = [resolve("metric", part) for part in parts["metric"]]
    if data is None:
        data = loading.reader(description)
        data.prepare()
    values = settings or Settings.of(description.settings)
    remark = meet_budget(
        predictor,
        data,
        build_metrics(parts, description.target),
        budget,
        samples=values.samples,
        seed=values.seed,
        batch_size=batch_size,
        work=work,
    )
    return replace(description, remarks=(*description.remarks, remark))
