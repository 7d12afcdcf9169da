"""Compare the training of ten small networks together, as an ensemble, with training them one after the other.

    python -m benchmarks.densities.ensemble

The data are the two moons (synthetic), on two threads. Whole trainings are timed, interleaved in one process, with a
bare PyTorch loop and with the framework's Trainer. The script also compares each member with the same network trained
alone, and the distribution of the members' test NLLs with that of networks trained alone from other seeds. Writes
ensemble.md into the folder of this file.
"""

import logging
import statistics
import tempfile
import time
import warnings
from collections.abc import Callable

import numpy as np
import pytorch_lightning as pl
import torch
from scipy import stats
from torch import Tensor

from benchmarks.pages import machine, publish
from framework.configuration.assembly import assemble, build_predictor
from framework.configuration.schema import build, resolve
from framework.configuration.settings import OptimizerSettings, Settings
from framework.data import Data
from framework.model import Model, Predictor
from framework.training.batches import Batches, epoch_order
from framework.training.module import OPTIMIZERS, LoadedBatches, Training
from framework.uncertainty import outermost, own_batches
from plugins.uncertainty.members.ensemble import Ensemble, network

MEMBERS, BATCH, EPOCHS, ROUNDS = 10, 50, 20, 3
LEARNING_RATE = 1e-3


def build_network(data: Data, width: int, seed: int, members: int | None = None) -> Predictor:
    """Return a model with two hidden layers, or an ensemble of such models."""
    config = {
        "data": "moons",
        "encoder": {"mlp": {"name": "mlp", "widths": [width, width]}},
        "density_head": "bernoulli",
    }
    if members:
        config["uncertainty"] = {"ensemble": {"name": "ensemble", "members": members}}
    return build_predictor(assemble(Settings.of(config)).parts, data.target, data.input_shape, seed)


def train_bare(
    predictor: Predictor, fields: dict[str, Tensor], epochs: int, seed: int, member: int = 0
) -> None:
    """Train in a minimal loop, with the optimiser and the batches of the framework; each member has its own batches.

    Args:
        predictor: the model or ensemble.
        fields: the training split.
        epochs: number of epochs.
        seed: seed of the order of the batches.
        member: for a model alone, the number of the member whose order of batches it gets.
    """
    optimizer = OPTIMIZERS["adam"](predictor.parameters(), lr=LEARNING_RATE)
    dtype = next(predictor.parameters()).dtype
    ensemble = outermost(predictor)
    members = range(ensemble.model_count) if ensemble else [member]
    with own_batches(predictor):
        for epoch in range(epochs):
            orders = torch.tensor(
                [epoch_order(len(fields["target"]), seed, epoch, number) for number in members]
            )
            for rows in orders.split(BATCH, 1):
                optimizer.zero_grad()
                index = rows.flatten()
                inputs, target = fields["input"][index].to(dtype), fields["target"][index]
                predictor.loss(inputs, target).mean().backward()
                optimizer.step()


def train_with_framework(predictor: Predictor, data: Data, epochs: int, seed: int) -> None:
    """Train with the framework's module and batches and Lightning's loops; nothing is validated or saved."""
    training = Training(
        predictor, [], data, OptimizerSettings(name="adam", learning_rate=LEARNING_RATE), seed, {}
    )
    ensemble = outermost(predictor)
    orders = ensemble.model_count if ensemble else 1
    batches = Batches(data, batch_size=BATCH, workers=0, seed=seed, orders=orders)
    with tempfile.TemporaryDirectory() as folder:
        trainer = pl.Trainer(
            max_epochs=epochs,
            accelerator="cpu",
            logger=False,
            enable_checkpointing=False,
            enable_progress_bar=False,
            enable_model_summary=False,
            limit_val_batches=0,
            use_distributed_sampler=False,
            default_root_dir=folder,
        )
        trainer.fit(training, datamodule=LoadedBatches(batches, trainer))


def seconds(call: Callable[[], object]) -> float:
    """Return the wall time of a call."""
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def time_loops(
    data: Data, fields: dict[str, Tensor], width: int
) -> dict[str, tuple[float, float, list[float]]]:
    """Return for each loop the median seconds of training together and one by one, and each round's speed-up."""

    def train_separately(train: Callable[[Predictor], None]) -> None:
        for seed in range(MEMBERS):
            train(build_network(data, width, seed))

    loops: dict[str, Callable[[Predictor], None]] = {
        "bare PyTorch loop": lambda predictor: train_bare(predictor, fields, EPOCHS, 0),
        "framework's Trainer": lambda predictor: train_with_framework(predictor, data, EPOCHS, 0),
    }
    times = {}
    for name, train in loops.items():
        pairs = []
        for _ in range(ROUNDS + 1):
            together = seconds(lambda train=train: train(build_network(data, width, 0, MEMBERS)))
            pairs.append((together, seconds(lambda train=train: train_separately(train))))
        rounds = pairs[1:]  # the first round warms up
        medians = [statistics.median(column) for column in zip(*rounds, strict=True)]
        times[name] = (medians[0], medians[1], [b / a for a, b in rounds])
    return times


def largest_difference(data: Data, fields: dict[str, Tensor], dtype: torch.dtype) -> float:
    """Return the largest difference of p(y|x) on the test split between members and the same networks trained alone."""
    ensemble = build_network(data, 128, 0, MEMBERS).to(dtype)
    assert isinstance(ensemble, Ensemble) and ensemble.together is not None
    alone = []
    for index in range(MEMBERS):
        model = build_network(data, 128, 0).to(dtype)
        assert isinstance(model, Model)
        network(model).load_state_dict(ensemble.together.read(index))
        alone.append(model)
    train_bare(ensemble, fields, EPOCHS, 0)
    test = data.splits().test.fields["input"].to(dtype)  # type: ignore[attr-defined]
    label = torch.ones(len(test), dtype=torch.int64)
    worst = 0.0
    for index, model in enumerate(alone):
        train_bare(model, fields, EPOCHS, 0, index)
    with torch.no_grad():
        together = ensemble.training_densities(test).log_prob(label[:, None]).exp()
        for index, model in enumerate(alone):
            worst = max(worst, float((together[:, index] - model(test).log_prob(label).exp()).abs().max()))
    return worst


def compare_nlls(
    data: Data, fields: dict[str, Tensor], count: int, epochs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the test NLLs of three groups of networks.

    The groups are the members of one ensemble, networks trained alone from other initial weights with the same order
    of batches, and networks trained alone from other initial weights with other orders of batches.
    """
    test = data.splits().test.fields  # type: ignore[attr-defined]
    ensemble = build_network(data, 128, 0, count)
    train_bare(ensemble, fields, epochs, 0)
    with torch.no_grad():
        members = -ensemble.training_densities(test["input"]).log_prob(test["target"][:, None]).mean(0)
    alone: dict[bool, list[float]] = {True: [], False: []}
    for same_order, nlls in alone.items():
        for seed in range(1000, 1000 + count):
            model = build_network(data, 128, seed)
            train_bare(model, fields, epochs, 0 if same_order else seed)
            with torch.no_grad():
                nlls.append(float(-model(test["input"]).log_prob(test["target"]).mean()))
    return members.numpy(), np.array(alone[True]), np.array(alone[False])


def format_mean(values: np.ndarray) -> str:
    """Return mean ± standard deviation as text."""
    return f"{values.mean():.4f} ± {values.std(ddof=1):.4f}"


def main() -> None:
    torch.set_num_threads(2)
    warnings.filterwarnings("ignore")
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    data: Data = build("data", resolve("data", "moons"))
    data.prepare()
    fields: dict[str, Tensor] = data.splits().train.fields  # type: ignore[attr-defined]
    lines = [
        "| hidden layers | training loop | together, s | one after the other, s | speed-up | speed-up in each round |",
        "|---|---|---|---|---|---|",
    ]
    for width in (32, 128, 512):
        for loop, (together, separate, speedups) in time_loops(data, fields, width).items():
            cells = [f"{width}-{width}", loop, f"{together:.2f}", f"{separate:.2f}"]
            cells += [f"**{separate / together:.1f}**", ", ".join(f"{speedup:.1f}" for speedup in speedups)]
            lines.append(f"| {' | '.join(cells)} |")
    gaps = {name: largest_difference(data, fields, dtype) for name, dtype in DTYPES.items()}
    members, same_order, other_orders = compare_nlls(data, fields, 30, 60)
    text = (
        "# Ensembles: ten networks trained together or one after the other (synthetic data)\n\n"
        f"This page shows how much faster {MEMBERS} small networks are trained together, as members of one ensemble "
        "with batched matrix products, than one after the other. It also compares the resulting "
        "networks. It is written by `python -m benchmarks.densities.ensemble`.\n\n"
        "The 10 networks of an ensemble are `mlp` encoders with the head `bernoulli` on the data set `moons` "
        f"({len(fields['target'])} training points). They are trained with Adam for {EPOCHS} epochs in batches of "
        f"{BATCH}, on two threads. The first column gives the widths of the two hidden layers. The training loop is "
        "either a minimal loop in PyTorch or the framework's Trainer. Times are wall times of the whole training of "
        f"all {MEMBERS} networks, medians of {ROUNDS} rounds in which the two trainings alternate. The speed-up is "
        "the time of training one after the other, divided by the time of training together (ratio of the two "
        "medians).\n\n"
        + "\n".join(lines)
        + "\n\n**A member of an ensemble is equal to a network that is trained alone.** Each member with two hidden "
        "layers of 128 units was compared with the same network trained alone, with the same initial weights and "
        "the same batches. After the training, the largest difference of the predicted probability p(y|x) on 5000 "
        "test points is "
        + " and ".join(f"{gap:.1e} in {name}" for name, gap in gaps.items())
        + ".\n\n**The test results of members have the same distribution as those of networks that are trained alone, "
        "if each network that is trained alone reads the batches in its own order.** The following list compares the "
        "negative log-likelihood (NLL) on the test split after 60 epochs, as mean ± standard deviation over the "
        "networks. The number p is the p-value of a Kolmogorov-Smirnov test against the members of the ensemble:\n"
        f"- 30 members of one ensemble: {format_mean(members)};\n"
        "- 30 networks trained alone, which have different initial weights but read the batches in the same order: "
        f"{format_mean(same_order)}, p = {stats.ks_2samp(members, same_order).pvalue:.2f};\n"  # type: ignore[attr-defined]
        "- 30 networks trained alone, which have different initial weights and read the batches in different "
        "orders: "
        f"{format_mean(other_orders)}, p = {stats.ks_2samp(members, other_orders).pvalue:.2f}.\n\n"  # type: ignore[attr-defined]
        "Each member of an ensemble in this project reads the batches in its own order, because eq. 2.17 of the "
        "thesis assumes networks that are trained independently.\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    publish(__file__, text)


DTYPES = {"float32": torch.float32, "float64": torch.float64}

if __name__ == "__main__":
    main()
