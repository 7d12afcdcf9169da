"""Recognise body parts, point by point, from the encoding of the whole cloud (thesis §8.2).

    python -m benchmarks.clouds.segmentation

Scans of data=registration; a point's part is that of the nearest vertex of its body. The same network reads a point's
normalised coordinates alone, or with the code of its cloud (`per_point`). Writes segmentation.md and
segmentation.png beside this file; five minutes on one core. The default body is wanted: pip install -e '.[body]'.
"""

import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from matplotlib import colormaps
from matplotlib.patches import Patch
from torch import Tensor, nn

from benchmarks.pages import machine, write_page
from framework.bodies import poses
from framework.bodies.body import Body
from framework.bodies.people import load_body
from framework.configuration.schema import build, resolve
from framework.figures.style import titled_figure
from framework.geometry.clouds import sizes
from framework.geometry.nearest import nearest
from framework.reports.table import markdown
from plugins.encoder.bps.basis import basis
from plugins.encoder.bps.encoding import Basis, encode, per_point, prepared

HERE = Path(__file__).resolve()
TRAIN, TEST, BASIS = 2_000, 200, 512
EPOCHS, SCANS, POINTS = 20, 8, 256
"""Of training: epochs, scans of a batch, points of a scan in each epoch."""
LIMBS = {
    "neck": "head",
    "arm": "upper arm",
    "elbow": "forearm",
    "wrist": "hand",
    "hip": "thigh",
    "knee": "shin",
    "ankle": "foot",
}
"""The joint that a limb begins at, and the limb."""


def parts_of(body: Body) -> tuple[list[str], Tensor]:
    """Names of the parts, and of each vertex the part that its weightiest joint hangs on."""
    where = poses.skeleton(body)
    names, start = ["torso"], {}
    for limb in LIMBS:
        joints = getattr(where, limb)
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


def labelled(split, count: int, vertex_part: Tensor) -> tuple[Tensor, Tensor]:
    """Clouds (scan, point, 3) padded with NaN, and the part of each point; -1 of padding and strangers."""
    clouds, labels = [], []
    for first in range(0, count, 50):
        batch = split.__getitems__(range(first, min(count, first + 50)))
        vertices = batch["target"].float().unflatten(1, (-1, 3)).contiguous()
        number = sizes(batch["input"])
        found = nearest(vertices, batch["input"].nan_to_num(0), None, number)
        label = vertex_part[found.index].clone()
        far = found.distance * batch["scale"][:, None] > 0.1  # metres: no point of the body
        label[far | batch["input"].isnan().any(-1)] = -1
        clouds.append(batch["input"])
        labels.append(label)
    widest = max(cloud.shape[1] for cloud in clouds)
    clouds = [
        nn.functional.pad(cloud, (0, 0, 0, widest - cloud.shape[1]), value=torch.nan) for cloud in clouds
    ]
    labels = [nn.functional.pad(label, (0, widest - label.shape[1]), value=-1) for label in labels]
    return torch.cat(clouds), torch.cat(labels)


def inputs(clouds: Tensor, made: Basis, points: Tensor, whole: bool) -> Tensor:
    """What the network reads of some points (scan, point, 3) of clouds."""
    return per_point(encode(clouds, made, ["distance"], "none"), points) if whole else points


def trained(clouds: Tensor, labels: Tensor, classes: int, made: Basis, whole: bool) -> nn.Sequential:
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(0)
    layers = [nn.Linear(3 + (BASIS if whole else 0), 256), nn.ReLU(), nn.Linear(256, 128), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Linear(128, classes))
    optimizer = torch.optim.Adam(network.parameters(), 1e-3, fused=True)
    steps = EPOCHS * (len(clouds) // SCANS)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(EPOCHS):
        for chosen in torch.randperm(len(clouds), generator=generator).split(SCANS)[: len(clouds) // SCANS]:
            drawn = torch.multinomial((labels[chosen] >= 0).float(), POINTS, generator=generator)
            points = clouds[chosen].gather(1, drawn[..., None].expand(-1, -1, 3))
            said = network(inputs(clouds[chosen], made, points, whole))
            loss = nn.functional.cross_entropy(said.flatten(0, 1), labels[chosen].gather(1, drawn).flatten())
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            schedule.step()
    return network


@torch.inference_mode()
def judged(
    network: nn.Sequential, clouds: Tensor, labels: Tensor, made: Basis, whole: bool
) -> dict[str, float]:
    """Share of right points and its standard error over scans, mean intersection over union, milliseconds a scan."""
    last = network[-1]
    assert isinstance(last, nn.Linear)
    classes = last.out_features
    right, spent = [], []
    table = torch.zeros(classes, classes)
    for cloud, label in zip(clouds, labels, strict=True):
        known = label >= 0
        cloud = cloud[: int(sizes(cloud[None]))][None]
        start = perf_counter()
        guess = network(inputs(cloud, made, cloud, whole))[0].argmax(-1)
        spent.append(perf_counter() - start)
        guess, label = guess[known[: len(guess)]], label[known]
        right.append((guess == label).double().mean())
        table += torch.bincount(label * classes + guess, minlength=classes**2).reshape(classes, classes)
    shares = torch.stack(right)
    union = table.sum(0) + table.sum(1) - table.diagonal()
    return {
        "accuracy": shares.mean().item(),
        "accuracy_sem": (shares.std() / len(shares) ** 0.5).item(),
        "overlap": (table.diagonal() / union).mean().item(),
        "ms": 1e3 * float(np.median(spent)),
    }


def pictured(clouds: Tensor, labels: Tensor, said: dict[str, list[Tensor]], names: list[str]) -> None:
    """Scans from the front: true parts, and what each network says."""
    rows = {"truth": list(labels), **said}
    figure = titled_figure(
        (2.0 * len(clouds) + 0.5, 2.4 * len(rows) + 1.3), "Parts of bodies, point by point", True
    )
    panels = figure.subplots(len(rows), len(clouds), squeeze=False)
    for line, (heading, found) in zip(panels, rows.items(), strict=True):
        line[0].set_ylabel(heading, fontsize=11, weight="bold")
        for axes, cloud, label, true in zip(line, clouds, found, labels, strict=True):
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
    clouds, labels = labelled(data.splits().train, TRAIN, vertex_part)
    held = labelled(data.splits().test, TEST, vertex_part)
    made = prepared(basis("ball_uniform", BASIS, 1.0, 13).float())
    rows, said = [], {}
    for heading, whole in (("the point alone", False), ("with its cloud's code", True)):
        start = perf_counter()
        network = trained(clouds, labels, len(names), made, whole)
        spent = perf_counter() - start
        rows.append(
            {"reads": heading, **judged(network, *held, made, whole), "train": spent, "synthetic": True}
        )
        with torch.inference_mode():
            some = held[0][:5]
            said[heading] = list(network(inputs(some, made, some.nan_to_num(0), whole)).argmax(-1))
    pictured(held[0][:5], held[1][:5], said, names)
    columns = {
        "reads": "the network reads",
        "accuracy": "accuracy",
        "overlap": "mean intersection over union",
        "ms": "ms a scan of 10,000 points",
        "train": "training, s",
    }
    text = (
        f"# Parts of bodies, point by point (thesis §8.2)\n\n{TRAIN} scans of synthetic people for training, {TEST} "
        f"for the test, {len(names)} parts ({', '.join(names)}); {BASIS} basis points, layers of 256 and 128 units, "
        f"{EPOCHS} epochs of {POINTS} points a scan. Strangers' points do not count. One thread, encoding included.\n\n"
        f"{markdown(rows, columns, better={'accuracy': 'higher', 'overlap': 'higher', 'ms': 'lower'})}"
        f"\n![Five scans](segmentation.png)\n\n{machine('torch', 'numba')}\n"
    )
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    main()
