"""Time ten small networks that are trained side by side and one after the other.

    python -m benchmarks.densities.ensemble

On the two moons (synthetic), two threads. Times of whole trainings, alternating in one process, as a bare PyTorch loop
and through the framework's Trainer; then whether members become what they become alone, and whether their test NLLs
are distributed like those of networks trained with seeds of their own. Writes ensemble.md beside this file.
"""

import logging
import statistics
import sys
import tempfile
import time
import warnings
from collections.abc import Callable

import numpy as np
import pytorch_lightning as pl
import torch
from scipy import stats
from torch import Tensor

from benchmarks.pages import machine, write_page
from framework.configuration.assembly import build_predictor, resolve_all
from framework.configuration.schema import build, resolve
from framework.configuration.settings import OptimizerSettings
from framework.data import Data
from framework.model import Model, Predictor
from framework.training.batches import Batches, epoch_order
from framework.training.module import OPTIMIZERS, Training
from framework.uncertainty import outermost, own_batches
from plugins.uncertainty.members.ensemble import Ensemble, network

MEMBERS, BATCH, EPOCHS, ROUNDS = 10, 50, 20, 3
LEARNING_RATE = 1e-3


def predictor(data: Data, width: int, seed: int, members: int | None = None) -> Predictor:
    config = {
        "data": "moons",
        "encoder": {"mlp": {"name": "mlp", "widths": [width, width]}},
        "density_head": "bernoulli",
    }
    if members:
        config["uncertainty"] = {"ensemble": {"name": "ensemble", "members": members}}
    return build_predictor(resolve_all(config), data.target, data.input_shape, seed)


def bare(built: Predictor, fields: dict[str, Tensor], epochs: int, seed: int, member: int = 0) -> None:
    """The plainest loop over the batches that the framework would give, with its optimiser: each member's own.

    Args:
        member: whose order of batches a network that trains alone has.
    """
    optimizer = OPTIMIZERS["adam"](built.parameters(), lr=LEARNING_RATE)
    dtype = next(built.parameters()).dtype
    several = outermost(built)
    members = range(several.model_count) if several else [member]
    with own_batches(built):
        for epoch in range(epochs):
            orders = torch.tensor([epoch_order(len(fields["target"]), seed, epoch, one) for one in members])
            for rows in orders.split(BATCH, 1):
                optimizer.zero_grad()
                given = rows.flatten()
                built.loss(fields["input"][given].to(dtype), fields["target"][given]).mean().backward()
                optimizer.step()


def framed(built: Predictor, data: Data, epochs: int, seed: int) -> None:
    """The framework's own training: its module, its batches, Lightning's loops; no validation, nothing saved."""
    training = Training(
        built, [], data, OptimizerSettings(name="adam", learning_rate=LEARNING_RATE), seed, {}
    )
    several = outermost(built)
    orders = several.model_count if several else 1
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
        batches.attach(trainer)
        trainer.fit(training, datamodule=batches)


def seconds(call: Callable[[], object]) -> float:
    start = time.perf_counter()
    call()
    return time.perf_counter() - start


def ratios(data: Data, fields: dict[str, Tensor], width: int) -> dict[str, tuple[float, float, list[float]]]:
    """Loop → median seconds together and apart, and the ratio of each round."""

    def apart(train: Callable[[Predictor], None]) -> None:
        for seed in range(MEMBERS):
            train(predictor(data, width, seed))

    loops: dict[str, Callable[[Predictor], None]] = {
        "bare PyTorch loop": lambda built: bare(built, fields, EPOCHS, 0),
        "framework's Trainer": lambda built: framed(built, data, EPOCHS, 0),
    }
    found = {}
    for name, train in loops.items():
        pairs = []
        for _ in range(ROUNDS + 1):
            together = seconds(lambda train=train: train(predictor(data, width, 0, MEMBERS)))
            pairs.append((together, seconds(lambda train=train: apart(train))))
        kept = pairs[1:]  # the first round warms up
        medians = [statistics.median(times) for times in zip(*kept, strict=True)]
        found[name] = (medians[0], medians[1], [b / a for a, b in kept])
    return found


def differences(data: Data, fields: dict[str, Tensor], dtype: torch.dtype) -> float:
    """The largest difference of p(y|x) on the test split between members and the same networks trained alone."""
    whole = predictor(data, 128, 0, MEMBERS).to(dtype)
    assert isinstance(whole, Ensemble) and whole.together is not None
    alone = []
    for index in range(MEMBERS):
        model = predictor(data, 128, 0).to(dtype)
        assert isinstance(model, Model)
        network(model).load_state_dict(whole.together.read(index))
        alone.append(model)
    bare(whole, fields, EPOCHS, 0)
    test = data.splits().test.fields["input"].to(dtype)  # type: ignore[attr-defined]
    label = torch.ones(len(test), dtype=torch.int64)
    worst = 0.0
    for index, model in enumerate(alone):
        bare(model, fields, EPOCHS, 0, index)
    with torch.no_grad():
        together = whole.training_densities(test).log_prob(label[:, None]).exp()
        for index, model in enumerate(alone):
            worst = max(worst, float((together[:, index] - model(test).log_prob(label).exp()).abs().max()))
    return worst


def spread(
    data: Data, fields: dict[str, Tensor], count: int, epochs: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Test NLL of members of one ensemble; of networks trained apart from starts of their own in the same order of
    batches; and of such with orders of their own."""
    test = data.splits().test.fields  # type: ignore[attr-defined]
    whole = predictor(data, 128, 0, count)
    bare(whole, fields, epochs, 0)
    with torch.no_grad():
        members = -whole.training_densities(test["input"]).log_prob(test["target"][:, None]).mean(0)
    apart: dict[bool, list[float]] = {True: [], False: []}
    for same, found in apart.items():
        for seed in range(1000, 1000 + count):
            model = predictor(data, 128, seed)
            bare(model, fields, epochs, 0 if same else seed)
            with torch.no_grad():
                found.append(float(-model(test["input"]).log_prob(test["target"]).mean()))
    return members.numpy(), np.array(apart[True]), np.array(apart[False])


def told(values: np.ndarray) -> str:
    return f"{values.mean():.4f} ± {values.std(ddof=1):.4f}"


def main() -> None:
    torch.set_num_threads(2)
    warnings.filterwarnings("ignore")
    logging.getLogger("pytorch_lightning").setLevel(logging.ERROR)
    data: Data = build("data", resolve("data", "moons"))
    data.prepare()
    fields: dict[str, Tensor] = data.splits().train.fields  # type: ignore[attr-defined]
    lines = ["| network | loop | together, s | apart, s | ratio | rounds |", "|---|---|---|---|---|---|"]
    for width in (32, 128, 512):
        for loop, (together, apart, rounds) in ratios(data, fields, width).items():
            tried = ", ".join(f"{ratio:.1f}" for ratio in rounds)
            lines.append(
                f"| {width}-{width} | {loop} | {together:.2f} | {apart:.2f} | **{apart / together:.1f}** | {tried} |"
            )
    gaps = {name: differences(data, fields, dtype) for name, dtype in DTYPES.items()}
    members, same, own = spread(data, fields, 30, 60)
    text = (
        "# Ensembles: ten networks side by side against one after the other (synthetic data)\n\n"
        f"`python -m benchmarks.densities.ensemble`: `mlp` + `bernoulli` on `moons` ({len(fields['target'])} training "
        f"points), Adam, batches of {BATCH}, {EPOCHS} epochs, two threads; seconds of a whole training of {MEMBERS} "
        "networks, "
        f"median of {ROUNDS} alternating rounds.\n\n" + "\n".join(lines) + "\n\n"
        "**The same for given seeds.** Largest difference of p(y|x) on 5000 test points between a member (128-128) and "
        "the same network trained alone from the same start on the same batches, after the training: "
        + ", ".join(f"{gap:.1e} in {name}" for name, gap in gaps.items())
        + ".\n\n**Alike in distribution.** Test NLL (mean ± SD) after 60 epochs of 30 members of one ensemble: "
        f"{told(members)}; of 30 networks trained alone from other starts in the same order of batches: {told(same)}, "
        f"Kolmogorov-Smirnov p = {stats.ks_2samp(members, same).pvalue:.2f}; with orders of their own as well: "  # type: ignore[attr-defined]
        f"{told(own)}, p = {stats.ks_2samp(members, own).pvalue:.2f}. "  # type: ignore[attr-defined]
        "Members have orders of their own (eq. 2.17: independently trained).\n\n"
        f"{machine('torch', 'pytorch-lightning')}\n"
    )
    write_page(__file__, text)
    sys.stdout.write(text)


DTYPES = {"float32": torch.float32, "float64": torch.float64}

if __name__ == "__main__":
    main()
