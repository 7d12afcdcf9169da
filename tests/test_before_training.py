"""Mistakes that can be found without training are reported before it; unused parts cost nothing."""

import json
import math
from pathlib import Path

import pytest
import pytorch_lightning as pl
import torch

from framework.data import Batch, Data, Splits
from framework.datasets.fields import Fields
from framework.errors import DataError, UserError
from framework.target import Kind, Target
from framework.training.batches import Batches, require_targets
from tests.conftest import Framework

TARGETS: dict[Kind, Target] = {
    "angle": Target("angle", ("pan",)),
    "real": Target("real", ("height", "width")),
    "class": Target("class", ("left", "middle", "right")),
    "image": Target("image", ("red", "green", "blue"), size=(4, 5)),
}
ROWS = 6
FAULTS = {
    "without its last dimension": lambda truth: truth[..., 0],
    "with one more": lambda truth: truth[..., None],
    "twice as wide": lambda truth: torch.cat([truth, truth], -1),
    "of other samples": lambda truth: truth[:-1],
    "of one for all": lambda truth: truth[:1],
}
SMALL = ["encoder=[mlp]", "encoder.mlp.widths=[4]", "batch_size=8", "threads=1", "samples=20", "logger=none"]
SMALL += ["trainer.max_epochs=1", "data=trial"]


def targets(target: Target) -> Batch:
    truth = torch.rand(ROWS, *target.event_shape)
    truth = torch.arange(ROWS) % len(target.names) if target.kind == "class" else truth
    return {"input": torch.zeros(ROWS, 2), "target": truth}


def given(fields: Fields) -> Data:
    """Return a data set that holds the same samples three times."""
    kind = type("Given", (Data,), {"splits": lambda self: Splits(fields, fields, fields)})
    kind.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]
    data: Data = kind()
    data.target = TARGETS["class"]
    return data


@pytest.mark.parametrize("kind", TARGETS)
def test_targets_of_the_right_shape_pass(kind: Kind) -> None:
    batch = targets(TARGETS[kind])
    assert require_targets(batch, TARGETS[kind])["target"] is batch["target"]
    nobody = {name: field[:0] for name, field in batch.items()}
    assert len(require_targets(nobody, TARGETS[kind])["target"]) == 0


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("kind", TARGETS)
def test_targets_of_another_shape_are_refused(kind: Kind, fault: str) -> None:
    batch = targets(TARGETS[kind])
    wrong = {**batch, "target": FAULTS[fault](batch["target"])}
    with pytest.raises(DataError, match=r"of shape .*, but shape \(6"):
        require_targets(wrong, TARGETS[kind])


@pytest.mark.parametrize(
    ("label", "workers", "split"),
    [
        *((label, 0, split) for label in (-1, 3, 7, math.nan) for split in ("train", "val", "test")),
        (7, 1, "train"),
    ],
)
def test_a_label_of_no_class_is_refused_wherever_it_is_read(label: float, workers: int, split: str) -> None:
    fields = targets(TARGETS["class"])
    fields["target"] = fields["target"].to(torch.float32 if math.isnan(label) else torch.int64)
    fields["target"][-1] = label

    data = given(Fields(**fields))
    batches = Batches(data, batch_size=ROWS, workers=workers, seed=0)
    if split == "train":
        batches.attach(pl.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False))
    loader = getattr(batches, f"{split}_dataloader")()
    with pytest.raises(UserError, match=f"is {label}, but class indices go from 0 to 2"):
        next(iter(loader))


@pytest.mark.parametrize(
    ("chosen", "said"),
    [
        (["density_head=gaussian", "data.kind=real", "data.fault=flat"], "but shape (2, 1) is required"),
        (["density_head=gaussian", "data.kind=real", "data.fault=wide"], "but shape (2, 1) is required"),
        (["density_head=von_mises", "data.kind=angle", "data.fault=flat"], "but shape (2, 1) is required"),
        (["density_head=von_mises", "data.kind=angles", "data.fault=column"], "but shape (2, 2) is required"),
        (["density_head=categorical", "data.kind=class", "data.fault=column"], "but shape (2,) is required"),
        (
            ["density_head=categorical", "data.kind=class", "data.fault=label"],
            "is 7, but class indices go from 0 to 1",
        ),
        (
            ["density_head=categorical", "data.kind=class", "data.fault=below"],
            "is -1, but class indices go from 0 to 1",
        ),
        (
            ["density_head=wrapped_cauchy", "data.kind=angles", "uncertainty=[temperature]"],
            "cannot be changed",
        ),
        (
            [
                "density_head=wrapped_cauchy",
                "data.kind=angles",
                "uncertainty=[ensemble,conformal,temperature]",
            ],
            "cannot be changed",
        ),
        (
            ["density_head=von_mises", "+metric.two.name=listed"],
            "'mean_entropy' with shape (3,), but each name must have one number",
        ),
        (["density_head=von_mises", "+metric.two.name=log_likelihood"], "Two metrics use the name"),
        (
            ["density_head=von_mises", "+metric.two.name=mean_entropy", "+metric.three.name=listed"],
            "Two metrics use the name 'mean_entropy': MeanEntropy and Listed",
        ),
    ],
)
def test_a_mistake_that_needs_no_training_is_found_before_it(
    framework: Framework, chosen: list[str], said: str
) -> None:
    done = framework(*SMALL, "metric=[log_likelihood]", "pictures=false", *chosen)
    assert done.code == (2 if "+metric" in " ".join(chosen) else 1), done.out
    assert said in done.out
    assert "Traceback" not in done.out
    trained = "label" in " ".join(chosen) or "below" in " ".join(chosen)
    assert (done.folder / "checkpoints").exists() == trained, "nothing of a run that was refused is left"


def test_a_label_of_the_test_split_costs_the_test_alone(framework: Framework) -> None:
    chosen = ["density_head=categorical", "data.kind=class", "metric=[accuracy]", "pictures=false"]
    done = framework(*SMALL, *chosen, "data.fault=last label")
    assert done.code == 1, done.out
    assert "is 7, but class indices go from 0 to 1" in done.out
    assert "Traceback" not in done.out
    data = ("data=trial", "data.kind=class", "data.fault=none", "metric=[accuracy]", "logger=none")
    again = framework("mode=test", f"checkpoint={done.folder}", *data, "pictures=false", folder="again")
    assert again.code == 0, again.out


def test_a_picture_that_nobody_asked_for_costs_no_table(framework: Framework) -> None:
    """Third-party parts with omissions: a density of two angles without marginals, a metric without a direction, and
    data that do not report skipped samples."""
    done = framework(
        *SMALL,
        "density_head=silent",
        "data.kind=angles",
        "metric=[log_likelihood]",
        "+metric.m.name=mean_entropy",
    )
    assert done.code == 0, done.out
    assert "No figure of predictions" in done.out
    results = json.loads((done.folder / "results.json").read_text(encoding="utf-8"))
    assert math.isfinite(results["mean_entropy"])


def test_a_model_predicts_where_its_metrics_package_is_missing(framework: Framework, tmp_path: Path) -> None:
    here = tmp_path / "here"
    here.mkdir()
    (here / "only_where_it_was_trained.py").touch()
    chosen = ["density_head=von_mises", "metric=[log_likelihood]", "pictures=false"]
    done = framework(*SMALL, *chosen, "+metric.needing.name=needing", paths=(here,))
    assert done.code == 0, done.out
    model = f"checkpoint={done.folder}"
    predicted = framework("mode=predict", model, "logger=none", folder="predicted")
    assert predicted.code == 0, predicted.out
    tested = framework("mode=test", model, "logger=none", folder="tested")
    assert tested.code == 2
    assert "needs the module 'only_where_it_was_trained'" in tested.out
    chosen = framework("mode=test", model, "logger=none", "metric=[log_likelihood]", folder="chosen")
    assert chosen.code == 0, chosen.out
