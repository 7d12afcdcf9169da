"""mode=predict: a CSV of point predictions and uncertainties for a user's own files, or for the test split; images as
PNG files beside it."""

import csv
from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor
from torch.utils.data import DataLoader

from framework.configuration.config import Config, Options
from framework.configuration.settings import Settings
from framework.data import Data
from framework.datasets.fields import as_batch
from framework.datasets.png import png
from framework.distributions.noise import Draw
from framework.errors import DataError
from framework.evaluation.splits import BLOCK, predicted
from framework.model import Predictor
from framework.prediction import answers
from framework.runs.run import opened
from framework.runs.session import for_trained
from framework.runs.user_files import UNREADABLE, to_read
from framework.target import Target
from framework.training.batches import told


class PredictOptions(Options):
    """What to predict for: a file or a folder of files, or the test split."""

    files: str | None = None


def run(config: Config) -> None:
    """Write predictions.csv into the run folder."""
    wanted = config.options(PredictOptions).files
    files = _files(Path(wanted).expanduser()) if wanted else []
    session = for_trained(config, prepare=not files)
    bad: list[Path] = []
    if len(files) > 1:
        files, bad = to_read(session.data, files, session.parts["data"], session.console)
    with opened(session.config) as run:
        if bad:
            (run.folder / UNREADABLE).write_text("".join(f"{file}\n" for file in bad), encoding="utf-8")
        rows = predictions(
            session.predictor, session.data, session.target, files, session.settings, run.folder / "images"
        )
        path = run.folder / "predictions.csv"
        with path.open("w", newline="", encoding="utf-8") as stream:
            writer = csv.DictWriter(stream, list(rows[0]))
            writer.writeheader()
            writer.writerows(rows)
        run.tracker.log_artifact(path)
        session.console.print(f"{len(rows)} predictions in {path}", soft_wrap=True)


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise DataError(f"mode.files={path} does not exist. Give a file, or a folder of files.")
    found = [path] if path.is_file() else sorted(item for item in path.iterdir() if item.is_file())
    if not found:
        raise DataError(
            f"mode.files={path} is an empty folder. Give a folder that holds the files to predict for."
        )
    return found


@torch.no_grad()
def predictions(
    predictor: Predictor,
    data: Data,
    target: Target,
    files: Sequence[Path],
    settings: Settings,
    images: Path,
) -> list[dict[str, str]]:
    """One row a sample: its name, the point prediction, and the entropy of the density in nats.

    Predicted images are written into the folder `images`; the row names the file.
    """
    dataset = data.read(files) if files else data.splits().test
    loader = DataLoader(dataset, batch_size=BLOCK, collate_fn=as_batch)
    names = _names(data, files, len(dataset))  # type: ignore[arg-type]
    rows: list[dict[str, str]] = []
    for number, batch in enumerate(told(loader, "predicting")):
        prediction = predicted(predictor, batch, settings.samples, Draw(settings.seed, number))
        columns = answers(target, prediction.in_frame(data.frame(batch)))
        for row in range(len(batch["index"])):
            values = {key: _text(column[row]) for key, column in columns.items()}
            if target.kind == "class":
                values = {"class": target.names[int(prediction.point[row])], **values}
            elif target.kind == "image":
                file = images / f"{len(rows):05}.png"
                images.mkdir(exist_ok=True)
                file.write_bytes(png(prediction.image("color")[row]))
                values = {"image": f"{images.name}/{file.name}", **values}
            rows.append({"sample": names[len(rows)], **values})
    return rows


def _names(data: Data, files: Sequence[Path], samples: int) -> list[str]:
    """Of each sample: its file, with its row where a file holds several; without files its place in the test split."""
    if not files:
        return [f"test {number}" for number in range(samples)]
    if samples == len(files):
        return [str(file) for file in files]
    counts = [len(data.read([file])) for file in files]  # type: ignore[arg-type]
    return [f"{file} row {row}" for file, count in zip(files, counts, strict=True) for row in range(count)]


def _text(value: Tensor) -> str:
    return f"{float(value):.10g}"  # of a large number in the user's unit the small digits count
