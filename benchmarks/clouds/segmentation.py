"""Measure how accurately body parts are recognised point by point, with the encoding of the whole cloud (thesis §8.2).

    python -m benchmarks.clouds.segmentation

The data are scans of data=registration; the part of a point is the part of the nearest vertex of its body. The same
network reads the normalised coordinates of a point, either alone or with the encoding of the cloud (`per_point`).
Writes segmentation.md and segmentation.png into the folder of this file and takes five minutes on one core. It needs
the default body: pip install -e '.[body]'.
"""

from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.patches import Patch
from torch import Tensor, nn

from benchmarks.pages import machine, publish
from framework.bodies import poses
from framework.bodies.body import Body
from framework.bodies.people import load_body
from framework.configuration.schema import build, resolve
from framework.figures.style import titled_figure
from framework.geometry.clouds import sizes
from framework.geometry.nearest import nearest
from framework.reports.table import markdown
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import Basis, encode, per_point, prepare_basis

HERE = Path(__file__).resolve()
TRAIN, TEST, BASIS = 2_000, 200, 512
EPOCHS, SCANS, POINTS = 20, 8, 256
"""Size of the training: epochs, scans of a batch, points of a scan in each epoch."""
LIMBS = {
    "neck": "head",
    "arm": "upper arm",
    "elbow": "forearm",
    "wrist": "hand",
    "hip": "thigh",
    "knee": "shin",
    "ankle": "foot",
}
"""Limbs, by the joint at which each begins."""


def parts_of(body: Body) -> tuple[list[str], Tensor]:
    """Return the names of the parts, and for each vertex the part of the joint that has the largest weight there."""
    skeleton = poses.skeleton(body)
    names, start = ["torso"], {}
    for limb in LIMBS:
        joints = getattr(skeleton, limb)
        for side, joint in zip(("",) if limb == "neck" else ("left ", "right "), joints, strict=False):
            start[joint] = len(names)
            names.append(side + LIMBS[limb])
    part = []
    for joint in range(len(body.parents)):
        above = joint
        while above >= 0 and above not in start:
            above = body.parents[above]
        part.append(start.get(above, 0))
    return names, torch.tensor(part)[torch.from_numpy(body.weights.argmax(1))]


def load_labelled(split, count: int, vertex_part: Tensor) -> tuple[Tensor, Tensor]:
    """Return clouds (scan, point, 3) padded with NaN, and the part of each point; -1 marks padding and outliers."""
    clouds, labels = [], []
    for first in range(0, count, 50):
        batch = split.__getitems__(range(first, min(count, first + 50)))
        vertices = batch["target"].float().unflatten(1, (-1, 3)).contiguous()
        number = sizes(batch["input"])
        neighbours = nearest(vertices, batch["input"].nan_to_num(0), None, number)
        label = vertex_part[neighbours.index].clone()
        far = (
            neighbours.distance * batch["scale"][:, None] > 0.1
        )  # metres: an outlier, not a point of the body
        label[far | batch["input"].isnan().any(-1)] = -1
        clouds.append(batch["input"])
        labels.append(label)
    widest = max(cloud.shape[1] for cloud in clouds)
    clouds = [
        nn.functional.pad(cloud, (0, 0, 0, widest - cloud.shape[1]), value=torch.nan) for cloud in clouds
    ]
    labels = [nn.functional.pad(label, (0, widest - label.shape[1]), value=-1) for label in labels]
    return torch.cat(clouds), torch.cat(labels)


def network_inputs(clouds: Tensor, basis_points: Basis, points: Tensor, whole: bool) -> Tensor:
    """Return the network's inputs for `points` (scan, point, 3): coordinates and, if `whole`, the cloud's encoding."""
    return per_point(encode(clouds, basis_points, ["distance"], "none"), points) if whole else points


def train(clouds: Tensor, labels: Tensor, classes: int, basis_points: Basis, whole: bool) -> nn.Sequential:
    """Return a network that was trained to predict the part of a point."""
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    layers = [nn.Linear(3 + (BASIS if whole else 0), 256), nn.ReLU(), nn.Linear(256, 128), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Linear(128, classes))
    optimizer = torch.optim.Adam(network.parameters(), 1e-3, fused=True)
    steps = EPOCHS * (len(clouds) // SCANS)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(clouds), generator=generator).split(SCANS)[: len(clouds) // SCANS]:
            indices = torch.multinomial((labels[chosen] >= 0).float(), POINTS, generator=generator)
            points = clouds[chosen].gather(1, indices[..., None].expand(-1, -1, 3))
            logits = network(network_inputs(clouds[chosen], basis_points, points, whole)).flatten(0, 1)
            loss = nn.functional.cross_entropy(logits, labels[chosen].gather(1, indices).flatten())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network


@torch.inference_mode()
def evaluate(
    network: nn.Sequential, clouds: Tensor, labels: Tensor, basis_points: Basis, whole: bool
) -> dict[str, float]:
    """Return accuracy with its standard error over scans, mean intersection over union, and milliseconds per scan."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    classes = last.out_features
    right, seconds = [], []
    table = torch.zeros(classes, classes)
    for cloud, label in zip(clouds, labels, strict=True):
        known = label >= 0
        cloud = cloud[: int(sizes(cloud[None]))][None]
        start = perf_counter()
        guess = network(network_inputs(cloud, basis_points, cloud, whole))[0].argmax(-1)
        seconds.append(perf_counter() - start)
        guess, label = guess[known[: len(guess)]], label[known]
        right.append((guess == label).double().mean())
        table += torch.bincount(label * classes + guess, minlength=classes**2).reshape(classes, classes)
    shares = torch.stack(right)
    union = table.sum(0) + table.sum(1) - table.diagonal()
    return {
        "accuracy": shares.mean().item(),
        "accuracy_sem": (shares.std() / len(shares) ** 0.5).item(),
        "overlap": (table.diagonal() / union).mean().item(),
        "ms": 1e3 * float(np.median(seconds)),
    }


def draw_figure(
    clouds: Tensor, labels: Tensor, predictions: dict[str, list[Tensor]], names: list[str]
) -> None:
    """Draw scans from the front: a row with the true parts, and a row with the predictions of each network."""
    rows = {"truth": list(labels), **predictions}
    figure = titled_figure(
        (2.0 * len(clouds) + 0.5, 2.4 * len(rows) + 1.3), "Parts of bodies, point by point", True
    )
    panels = figure.subplots(len(rows), len(clouds), squeeze=False)
    for line, (heading, parts) in zip(panels, rows.items(), strict=True):
        line[0].set_ylabel(heading, fontsize=11, weight="bold")
        for axes, cloud, label, true in zip(line, clouds, parts, labels, strict=True):
            shown = true >= 0
            axes.scatter(*cloud[shown][:, :2].T, s=0.4, c=label[shown], cmap="tab20", vmin=-0.5, vmax=19.5)
            axes.set(xticks=[], yticks=[], frame_on=False, aspect="equal")
    colours = colormaps["tab20"](range(len(names)))
    handles = [Patch(color=colour, label=name) for colour, name in zip(colours, names, strict=True)]
    figure.legend(handles=handles, loc="outside lower center", ncols=5, fontsize=9, frameon=False)
    figure.savefig(HERE.with_suffix(".png"), dpi=80)


def main() -> None:
    torch.set_num_threads(1)
    data = build("data", resolve("data", {"name": "registration", "train": TRAIN, "test": TEST}))
    data.prepare()
    names, vertex_part = parts_of(load_body(None)[0])
    clouds, labels = load_labelled(data.splits().train, TRAIN, vertex_part)
    test_clouds, test_labels = load_labelled(data.splits().test, TEST, vertex_part)
    basis_points = prepare_basis(basis("ball_uniform", BASIS, 1.0, 13).float())
    rows, predictions = [], {}
    for heading, whole in (("point alone", False), ("point and cloud", True)):
        start = perf_counter()
        network = train(clouds, labels, len(names), basis_points, whole)
        seconds = perf_counter() - start
        rows.append(
            {
                "reads": heading,
                **evaluate(network, test_clouds, test_labels, basis_points, whole),
                "train": seconds,
                "synthetic": True,
            }
        )
        with torch.inference_mode():
            some = test_clouds[:5]
            logits = network(network_inputs(some, basis_points, some.nan_to_num(0), whole))
            predictions[heading] = list(logits.argmax(-1))
    draw_figure(test_clouds[:5], test_labels[:5], predictions, names)
    columns = {
        "reads": "input of the network",
        "accuracy": "accuracy",
        "overlap": "mean intersection over union",
        "ms": "ms per scan of 10,000 points",
        "train": "training time, s",
    }
    text = (
        "# Body parts, recognised point by point (thesis §8.2)\n\n"
        "This page shows whether a network recognises the body part of a point of a scan better if it reads the "
        "encoding of the whole cloud in addition to the coordinates of the point. One network reads the point alone. "
        f"The other also reads the distances from {BASIS} basis points to the cloud.\n\n"
        f"The scans show synthetic people: {TRAIN} scans are for training and {TEST} for the test. Each point belongs "
        f"to one of {len(names)} parts ({', '.join(names)}). Both networks have layers of 256 and 128 units and are "
        f"trained for {EPOCHS} epochs, with {POINTS} random points of each scan in an epoch. Points that do not belong "
        "to the body (outliers of the scan) are left out.\n\n"
        "The table compares the two networks. Accuracy is the share of points whose body part is recognised; ± is "
        "its standard error over the test scans. The intersection over union compares the predicted and the true "
        "points of a body part; the table gives its mean over the parts. The time per scan is a median over the test "
        "scans; it "
        "was measured on one thread and includes the encoding.\n\n"
        f"{markdown(rows, columns, better={'accuracy': 'higher', 'overlap': 'higher', 'ms': 'lower'})}"
        "\nThe figure shows the body parts of five test scans from the front: the true parts (top), the parts that "
        "the network predicts from the coordinates of each point (middle), and the parts that the other network "
        "predicts from these coordinates and the features of the whole cloud (bottom).\n\n"
        f"![True and recognised parts of five scans](segmentation.png)\n\n{machine('torch', 'numba')}\n"
    )
    publish(HERE, text)


if __name__ == "__main__":
    main()
