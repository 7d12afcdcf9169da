"""How fast the models of a sweep's runs are, each by itself: in the sweep the jobs disturb each other."""

import json
from pathlib import Path

import torch

from framework.configuration.assembly import build_data
from framework.configuration.loading import load_with_description
from framework.evaluation.splits import cost
from framework.training.batches import Batches


def milliseconds(run: Path, loaders: dict[str, Batches], batch: int = 16) -> float:
    """Of one sample in a batch, the density and the point prediction of the run's model, on torch's threads.

    Args:
        loaders: those of the data seen so far.
    """
    model, description = load_with_description(run)
    settings = json.dumps(description.config["data"], sort_keys=True, default=str)
    if settings not in loaders:
        data = build_data(description.config)
        data.prepare()
        loaders[settings] = Batches(data, batch_size=batch, workers=0, seed=0)
    inputs = next(iter(loaders[settings].test_dataloader()))
    return cost(model, inputs, samples=1000, device=torch.device("cpu")).milliseconds_per_sample
