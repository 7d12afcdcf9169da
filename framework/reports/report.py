"""Report at the end of a run: the result table, its numbers as JSON, figures, and hints for the next steps."""

import json
import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rich.console import Console

from framework.configuration.paths import shell_arguments
from framework.errors import UserError, count_of
from framework.evaluation.cost import REPEATS, SHORT_TEST_REPEATS, Cost
from framework.evaluation.splits import Evaluation, cost, evaluate
from framework.reports.table import COST_BETTER, COST_COLUMNS, Better, machine, results_table
from framework.runs.provenance import package_versions
from framework.runs.run import Run
from framework.runs.session import Session, note_idle_samples
from framework.storage.files import write_whole
from framework.training.batches import track_batches

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def report_test(run: Run, session: Session) -> None:
    """Test the model, measure its cost, print the table, write results.json and the figures, and log the numbers.

    Args:
        run: the run, whose folder and tracker receive the results.
        session: the session of the run, with the trained model.
    """
    settings, data, outliers, metrics = session.settings, session.data, session.outliers, session.metrics
    blocks = session.blocks()
    loader = blocks.test_dataloader()
    evaluation = evaluate(
        session.predictor,
        track_batches(loader, "testing"),
        metrics,
        groups=data.groups,
        samples=settings.samples,
        seed=settings.seed,
        device=session.device,
        outliers=()
        if outliers is None
        else track_batches(blocks.of(outliers.splits().test), "testing on outliers"),
    )
    batch = next(iter(session.batches().test_dataloader()))
    note_idle_samples(session, batch)
    run_cost = cost(
        session.predictor,
        batch,
        samples=settings.samples,
        device=session.device,
        repeats=SHORT_TEST_REPEATS if settings.is_short_test else REPEATS,
    )
    columns = {key: heading for metric in metrics for key, heading in metric.columns.items()}
    better: Better = {**{key: way for metric in metrics for key, way in metric.better.items()}, **COST_BETTER}
    synthetic = data.synthetic or (outliers is not None and outliers.synthetic)
    results = results_of(run, session.method, session.data_title, evaluation, run_cost, columns, better)
    results |= {"synthetic": synthetic, "test_samples": len(loader.dataset)}  # type: ignore[arg-type]
    record_results(run, results, evaluation, run_cost)
    rows = [  # no bold numbers, because the groups of test samples do not compete
        results,
        *({**results, **numbers, "method": f"  {name}"} for name, numbers in evaluation.groups.items()),
    ]
    title = f"{session.title}, {count_of(len(loader.dataset), 'test sample')}"  # type: ignore[arg-type]
    session.console.print(results_table(rows, {"method": "method", **columns, **COST_COLUMNS}, title=title))
    if settings.is_short_test:
        session.console.print(
            "note: this is a short run, such as debug=fast makes, of at most ten training batches. Its numbers show "
            "that every stage works, and not how good the model is.",
            soft_wrap=True,
        )
    if settings.pictures:
        _save_pictures(run, session, evaluation, synthetic)
    _next_steps(run, run_cost, session.console)


def _logged_names(run: Run) -> set[str]:
    """Return the names of the numbers that a resumed run has logged already and need not log again.

    The set is empty for a run that is not resumed.
    """
    return {name for line in run.tracker.journal.lines() for name in line.values} if run.resumed else set()


def _save_pictures(run: Run, session: Session, evaluation: Evaluation, synthetic: bool) -> None:
    """Save the figures of predictions and of metrics.

    If the density lacks a function that the figures of predictions need, a message is printed instead of these figures.
    The run does not fail, because its results are complete without them.
    """
    from framework.reports.prediction_pictures import prediction_pictures

    try:
        for name, figure in prediction_pictures(session):
            save_picture(run, figure, name)
    except UserError as error:
        session.console.print(f"No figure of predictions was drawn: {error}", soft_wrap=True, highlight=False)
    save_metric_figures(run, evaluation, session.title, synthetic=synthetic)


def save_metric_figures(run: Run, evaluation: Evaluation, title: str, *, synthetic: bool) -> None:
    """Save the figure of each metric that has one (`HasFigure`) in the run folder."""
    if not evaluation.metrics:  # frames without true images need no metric, and so no torchmetrics
        return
    from framework.metric import HasFigure

    for metric in evaluation.metrics:
        if isinstance(metric, HasFigure):
            save_picture(run, metric.figure(title, synthetic=synthetic), metric.figure_name)


def record_results(run: Run, results: dict[str, Any], evaluation: Evaluation, run_cost: Cost) -> None:
    """Write `results` as results.json, and log the file, the metrics and the cost to the store.

    Args:
        run: the run, whose folder and tracker receive the results.
        results: content of results.json (`results_of`).
        evaluation: values of the metrics.
        run_cost: cost of a prediction.
    """
    path = run.folder / "results.json"
    write_whole(path, json.dumps(results, indent=1).encode())
    numbers = {key: float(value) for key, value in asdict(run_cost).items() if isinstance(value, int | float)}
    groups = {f"test/{name}": values for name, values in evaluation.groups.items()}
    already_logged = _logged_names(run)
    for part, values in {"test": evaluation.total, **groups, "cost": numbers}.items():
        named = {f"{part}/{key}": value for key, value in values.items()}
        run.tracker.log_metrics(
            {name: value for name, value in named.items() if name not in already_logged}, 0, 0
        )
    run.tracker.log_artifact(path)


def results_of(
    run: Run,
    method: str,
    data: str,
    evaluation: Evaluation,
    run_cost: Cost,
    columns: dict[str, str],
    better: Better,
) -> dict[str, Any]:
    """Return the content of results.json.

    Args:
        run: the run, whose seed, experiment and folder are included.
        method: name of the model in tables.
        data: name of the data in tables.
        evaluation: values of the metrics.
        run_cost: cost of a prediction.
        columns: headings of the table, by key.
        better: for each key, whether a "higher" or a "lower" number is better.
    """
    return {
        "method": method,
        "experiment": run.settings.experiment_name,
        "data": data,
        "seed": run.settings.seed,
        **{key: _plain(value) for key, value in evaluation.total.items()},
        "groups": {
            name: {k: _plain(v) for k, v in numbers.items()} for name, numbers in evaluation.groups.items()
        },
        **{key: _plain(value) for key, value in asdict(run_cost).items()},
        "columns": columns,
        "better": better,
        "folder": str(run.folder),
        "versions": package_versions(),
    }


def _plain(value: Any) -> Any:
    """Return a value for results.json, where NaN becomes null; tables print null as "not available"."""
    return None if isinstance(value, float) and math.isnan(value) else value


def report_training(run: Run, session: Session, *, kept_epoch: int) -> None:
    """Draw the training curve from the journal and save it, unless the settings switch figures off.

    Args:
        run: the run with the journal.
        session: the session of the run.
        kept_epoch: epoch, from 0, of the weights that are kept and tested.
    """
    if not run.settings.pictures:
        return
    from framework.reports.training_curve import training_curve

    train: list[tuple[float, float]] = []
    validation: list[tuple[float, float]] = []
    steps_per_epoch = 1.0
    for line in run.tracker.journal.lines():
        if "train/loss" in line.values:
            train.append((line.step, line.values["train/loss"]))
        if "validation/loss" in line.values:
            steps_per_epoch = line.step / (line.epoch + 1)
            validation.append((line.epoch + 1, line.values["validation/loss"]))
    figure = training_curve(
        [step / steps_per_epoch for step, _ in train],
        [loss for _, loss in train],
        validation,
        best_epoch=kept_epoch + 1,
        title=f"{session.title}: training",
        synthetic=session.data.synthetic,
    )
    save_picture(run, figure, "training_curve")


def save_picture(run: Run, figure: "Figure", name: str) -> Path:
    """Save a figure in the run folder, in the format of the settings, log it to the store, and return its path.

    `name` is the name of the file without a suffix.
    """
    from framework.figures.style import save_figure

    folder = run.folder / "figures"
    folder.mkdir(exist_ok=True)
    path = save_figure(figure, folder / name, run.settings.pictures)
    run.tracker.log_artifact(path, "figures")
    return path


def _next_steps(run: Run, run_cost: Cost, console: Console) -> None:
    """Print the machine, the run folder and its files, and how to use the model."""
    files = ("figures", "results.json", "citations.bib", "checkpoints/model.ckpt")
    existing = [name for name in files if (run.folder / name).exists()]
    # A run that tests the model of another run has no model of its own.
    model = run.folder if files[-1] in existing else run.settings.checkpoint
    commands = [
        f"python -m framework mode=predict {_argument('checkpoint', model)} mode.files=<your files>",
        report_command(run),
        "and mode=calibrate, mode=export, sweeps: docs/commands.md",
    ]
    print_last_lines(run, run_cost, existing, [f"in a notebook: {load_call(model)}"], commands, console)


def print_last_lines(
    run: Run,
    run_cost: Cost,
    files: Sequence[str],
    steps: Sequence[str],
    commands: Sequence[str],
    console: Console,
    unit: str = "sample",
) -> None:
    """Print the machine, the run folder and its files, the lines `steps`, and the next commands.

    `unit` is the noun for the items that `run_cost` counts.
    """
    lines = [
        f"measured on {machine(run_cost.device, run_cost.threads)}, batches of {run_cost.batch_size}; "
        f"a single {unit} takes {run_cost.latency_milliseconds:.2f} ms",
        f"run folder:    {run.folder}   ({', '.join(files)})",
        f"all runs:      {run.tracker.url}",
        *steps,
        f"what to cite:  {run.folder / 'citations.bib'}",
        *(f"{'' if number else 'next commands:':15}{command}" for number, command in enumerate(commands)),
    ]
    console.print("\n".join(lines), soft_wrap=True, highlight=False, markup=False)


def load_call(model: Path | str | None) -> str:
    """Return the line of Python that loads a model from its run folder or checkpoint."""
    return f"framework.load({str(model)!r})"


def report_command(run: Run) -> str:
    """Return the command that writes a report on a run."""
    return f"python -m framework mode=report {_argument('mode.run', run.folder)}"


def _argument(key: str, path: Path | str | None) -> str:
    """Return the command-line argument that sets a key to a path, which is relative if it is in the working folder."""
    absolute = Path(str(path)).absolute()
    inside = absolute.is_relative_to(Path.cwd())
    return shell_arguments({key: f"./{absolute.relative_to(Path.cwd())}" if inside else str(absolute)})[0]
