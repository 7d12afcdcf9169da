"""mode=work_precision: measure error against run time for several values of a trained model's knob."""

from typing import Annotated, Literal

from pydantic import Field

from framework.configuration.assembly import build_metrics
from framework.configuration.config import Config, Options
from framework.configuration.modes import idle_sentence
from framework.configuration.settings import Positive
from framework.data import Batch
from framework.density_head import DensityHead
from framework.errors import ConfigError, count_of, did_you_mean
from framework.evaluation import reference
from framework.evaluation.splits import on_device
from framework.evaluation.tradeoff import first_knob, knob_owners, rows, tradeoff
from framework.metric import Metric
from framework.reports.report import save_picture
from framework.reports.table import Better, machine, results_table, write_csv
from framework.runs.job import refuse_idle
from framework.runs.run import Run, open_run
from framework.runs.session import Session, for_trained, note_idle_samples

ERROR, AXIS = "error_nats", "error of the mean log-likelihood (nats, RMS)"
"""Key of the error that is measured by default for a knob of a density head, and label of its axis."""


class WorkPrecisionOptions(Options):
    """Options of mode=work_precision.

    Attributes:
        knob: Name of the knob; None for the model's first knob.
        values: Values of the knob; None for those that the plugin declares.
        repeats: Number of seeds for each value of the knob.
        reference: Value of the knob at which the reference log-likelihoods are computed.
        limit: Number of test samples.
        metrics: Names of the numbers to measure, such as "nll" or "error_nats", the error of the log-likelihood. None:
            "error_nats" for a knob of a density head, all numbers of the metrics for a knob of a wrapper.
    """

    knob: str | None = None
    values: list[Positive] | None = None
    repeats: Annotated[int, Field(ge=2)] = 5
    reference: Positive = 10_000
    limit: Positive = 200
    metrics: list[str] | None = None


def run(config: Config) -> None:
    """Write work_precision.csv and a figure, and print a table that marks the points of the Pareto front."""
    options = config.options(WorkPrecisionOptions)
    session = for_trained(config)
    with open_run(session.config) as run:
        session.record(run)
        _measure(run, session, options)


def _measure(run: Run, session: Session, options: WorkPrecisionOptions) -> None:
    from framework.reports.tradeoff_picture import Floor, error_against_run_time

    predictor, data, parts, settings = session.predictor, session.data, session.parts, session.settings
    metrics = [metric for metric in build_metrics(parts, session.target) if "outliers" not in metric.splits]
    knob = options.knob or first_knob(predictor)
    owner = knob_owners(predictor, knob)[0]
    better = _choose_keys(options.metrics, metrics, own=isinstance(owner, DensityHead))
    measured = [key for key in better if key not in reference.COLUMNS]
    compared = len(measured) < len(better)
    _refuse_unmeasured(run.config, bool(measured), compared)
    predictor.to(session.device)
    batches = _first_samples(session, options.limit)
    note_idle_samples(session, batches[0])
    curve = tradeoff(
        predictor,
        batches,
        metrics if measured else (),
        knob=knob,
        values=options.values or owner.knobs[knob],
        reference=options.reference if compared else None,
        samples=settings.samples,
        repeats=options.repeats,
        seed=settings.seed,
    )
    table_rows = rows({session.method: curve}, better, synthetic=data.synthetic)
    path = run.folder / "work_precision.csv"
    write_csv(table_rows, None, path)
    run.tracker.log_artifact(path)
    for row, point in zip(table_rows, curve.points, strict=True):
        numbers = {key: value for key, value in point.numbers.items() if key in row}
        numbers["milliseconds"] = point.milliseconds
        run.tracker.log_metrics(
            {f"work_precision/{key}": value for key, value in numbers.items()}, point.value, 0
        )
    headings = {key: heading for metric in metrics for key, heading in metric.columns.items()}
    headings = (reference.COLUMNS if compared else {}) | {key: headings[key] for key in measured}
    floors = {}
    if curve.reference is not None:
        error = curve.reference.standard_error
        floors[ERROR] = Floor(error, f"below {error:.1g} nats, the standard error of the reference")
    figure = error_against_run_time(
        table_rows,
        {key: AXIS if key == ERROR else headings[key] for key in better},
        better,
        title=f"{session.title}: {'metrics' if measured else 'error'} against run time along {knob}",
        synthetic=data.synthetic,
        floors=floors,
        machine=f"{machine(curve.device, curve.threads)}, batches of {curve.batch_size}",
    )
    figures = [save_picture(run, figure, "work_precision")] if settings.pictures else []
    columns = {"method": "method", "value": knob, **headings, "milliseconds_per_sample": "ms / sample"}
    for key in better:
        columns[f"{key}_pareto"] = "Pareto" if len(better) == 1 else f"Pareto: {headings[key]}"
    console = session.console
    console.print(
        results_table(table_rows, columns, title=f"{session.title}, {count_of(curve.samples, 'test sample')}")
    )
    console.print("\n".join(map(str, [path, *figures])), soft_wrap=True, highlight=False)


def _refuse_unmeasured(config: Config, measured: bool, compared: bool) -> None:
    """Raise an error if the command sets something for a quantity that is not measured.

    Args:
        config: Config of the command.
        measured: Whether metrics are measured.
        compared: Whether the error of the log-likelihood against a reference is measured.

    Raises:
        ConfigError: The command contains a setting without effect; the message names the first one.
    """
    for key, used, why in (
        ("metric", measured, f"only {ERROR} is measured here, unless mode.metrics=[...] names metrics"),
        (
            "mode.reference",
            compared,
            f"only {ERROR} is compared with a reference, and mode.metrics does not name it",
        ),
    ):
        override = config.first_override(key)
        if override and not used:
            refuse_idle(config.folder, idle_sentence(override, why))


def _choose_keys(names: list[str] | None, metrics: list[Metric], *, own: bool) -> Better:
    """Return the keys of the quantities to measure, each with its better direction, "higher" or "lower".

    Args:
        names: Requested keys. None selects the error against a reference if `own` is True, and otherwise every key of
            `metrics` for which a metric states whether higher or lower values are better.
        metrics: Metrics of the session.
        own: Whether the knob is one of the density head, and not of an uncertainty wrapper.

    Raises:
        ConfigError: A key belongs to no metric, or it is not known whether its higher or lower values are better.
    """
    known: dict[str, Literal["higher", "lower"]] = {
        key: metric.better[key] for metric in metrics for key in metric.columns if key in metric.better
    }
    keys = names or ([ERROR] if own else list(known))
    known |= reference.BETTER
    for key in keys:
        if key not in known:
            raise ConfigError(
                f"mode.metrics names {key!r}, but every name must be that of a result for which a metric states "
                f"whether higher or lower is better.{did_you_mean(key, known)} Choose from {', '.join(known)}."
            )
    if not keys:
        raise ConfigError(
            "No metric of this command states whether higher or lower values are better. Choose one that does with "
            "metric=[...]."
        )
    return {key: known[key] for key in keys}


def _first_samples(session: Session, limit: int) -> list[Batch]:
    """Return the first `limit` test samples, in batches."""
    batches, count = [], 0
    for batch in on_device(session.batches().test_dataloader(), session.device):
        batches.append({name: tensor[: limit - count] for name, tensor in batch.items()})
        count += len(batches[-1]["index"])
        if count >= limit:
            break
    return batches
