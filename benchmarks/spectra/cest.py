"""Fit Lorentzian lines in a real brain slice: SciPy, batched least squares, a network, and a fit that starts from it.

    for seed in 0 1 2; do python -m framework experiment=cest/mlp data.root=/path/to/brain7T.mat seed=$seed threads=1 \\
        pictures=false logger=none hydra.run.dir=outputs/cest/$seed; done
    python -m benchmarks.spectra.cest outputs/cest/0 outputs/cest/1 outputs/cest/2

Writes cest.md, cest.csv, cest.png and cest_maps.png beside this file. One thread, processor time, all in one run.
With `--draw` it draws cest.png again from cest.csv, with `--only speed brain7T.mat` it writes the first section alone,
in four minutes and without networks.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.pages import machine, read_rows, replace_section, write_page
from benchmarks.spectra.cest_scipy import AGREEMENT, TIGHT, agreement, scipys, timed
from benchmarks.timing import ROUNDS, require_idle
from framework.configuration.loading import load_with_description
from framework.data import Batch
from framework.distributions.protocol import marginal
from framework.figures.style import BLUE, GREEN, GREY, RED, save_figure, titled_figure
from framework.model import Predictor
from framework.reports.table import Row, markdown, write_csv
from framework.spectra.fit import fit
from framework.spectra.spectrum import COUNT, spectrum
from framework.target import Target
from plugins.data.cest.data import CEST
from plugins.data.cest.maps import maps_of, slice_of
from plugins.data.cest.maps_picture import maps_figure
from plugins.data.cest.volumes import read_volume
from plugins.density_head.lorentzian.head import LorentzianHead
from plugins.uncertainty.conformal.wrapper import Conformal
from plugins.uncertainty.refined.wrapper import Refined

HERE = Path(__file__).with_suffix("")
STEPS = (1, 2, 3, 4, 5, 6, 8, 12, 300)
DETERMINED = 0.1
"""Share of a box's side below which a parameter's standard error says that the data determine it."""
BLOCK = 512
METHODS = {
    "method": "method",
    "ms": "ms a voxel",
    "times": "times SciPy's speed",
    "median": "median error, standard errors",
    "within": "within one standard error",
}
DOUBTS = {
    "case": "held-out spectra",
    "rise": "σ, times that as measured",
    "error": "error, times that as measured",
    "cover": "90 % intervals cover",
}


LEGEND = {
    "SciPy": "SciPy, at most so many evaluations",
    "least squares": "batched least squares, at most so many steps",
    "network": "network",
    "network, then least squares": "network, then so many steps of least squares",
}
LEAST = 1e-8
"""The smallest error that is drawn as it is."""


@torch.no_grad()
def means(model: Callable[[Tensor], torch.distributions.Distribution], inputs: Tensor) -> Tensor:
    return model(inputs).mean


class One(Predictor):
    """One number of a model's density, for intervals of its own."""

    def __init__(self, model: Predictor, number: int) -> None:
        super().__init__()
        self.model, self.number = model, number

    def forward(self, inputs: Tensor) -> torch.distributions.Distribution:
        return marginal(self.model(inputs), self.number)

    loss = training_densities = calibrate = lambda self, *_: None  # type: ignore[assignment]


def batches(fields: dict[str, Tensor], number: int) -> list[Batch]:
    target = fields["target"][:, number : number + 1]
    both = zip(fields["input"].split(BLOCK), target.split(BLOCK), strict=True)
    return [{"input": some, "target": labels} for some, labels in both]


def halves(fields: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    order = torch.randperm(len(fields["input"]), generator=torch.Generator().manual_seed(0))
    first, second = order.chunk(2)
    return tuple({name: tensor[some] for name, tensor in fields.items()} for some in (first, second))  # type: ignore[return-value]


@torch.no_grad()
def conformal_coverage(model: Predictor, validation: dict[str, Tensor], test: dict[str, Tensor]) -> Tensor:
    """Share of test targets in intervals promised to hold 90 %, of each number."""
    found = []
    for number in range(test["target"].shape[1]):
        wrapped = Conformal(lambda number=number: One(model, number), miscoverage=0.1, score="mass")
        wrapped.calibrate(batches(validation, number))
        inside = [wrapped(batch["input"]).contains(batch["target"]) for batch in batches(test, number)]
        found.append(torch.cat(inside).double().mean())
    return torch.stack(found)


class Voxels(NamedTuple):
    """The test split: parameters of least squares, their standard errors, and which the data determine."""

    target: Tensor
    error: Tensor
    determined: Tensor

    def median(self, found: Tensor | np.ndarray) -> float:
        return float(self.ratios(found).median())

    def within(self, found: Tensor | np.ndarray) -> float:
        return float((self.ratios(found) < 1).double().mean())

    def ratios(self, found: Tensor | np.ndarray) -> Tensor:
        off = (torch.as_tensor(found).double()[:, : self.target.shape[1]] - self.target).abs()
        return (off / self.error)[self.determined]


def voxels_of(data: CEST, test: dict[str, Tensor]) -> Voxels:
    wanted = data.parameters
    found = fit(test["input"], torch.tensor(data.offsets, dtype=torch.float64), wanted)
    told = slice(wanted.target_count)
    lower, upper = (torch.tensor(side[told]).double() for side in (wanted.lower, wanted.upper))
    target, error = found.parameters[:, told], found.root.square().sum(-1).sqrt()[:, told]
    inside = (target > lower + 1e-9) & (target < upper - 1e-9)
    return Voxels(target, error, inside & (error < DETERMINED * (upper - lower)))


def curves(
    network: Predictor, data: CEST, inputs: Tensor, test: dict[str, Tensor], voxels: Voxels
) -> dict[str, list[tuple[float, float, float]]]:
    """Milliseconds a voxel, median error in standard errors, and share within one, of each method's knob."""
    target = Target("real", data.parameters.target)

    def entry(model: Predictor | LorentzianHead) -> tuple[float, float, float]:
        _, spent = timed(lambda: means(model, inputs), len(inputs))
        found = means(model, test["input"])
        return spent, voxels.median(found), voxels.within(found)

    found: dict[str, list[tuple[float, float, float]]] = {"SciPy": []}
    for most in (*STEPS[:-1], 20, None):
        one = scipys(
            test["input"][::3].double().numpy(), np.array(data.offsets), data.parameters, TIGHT, most
        )
        some = Voxels(*(part[::3] for part in voxels))
        found["SciPy"].append((one.milliseconds, some.median(one.parameters), some.within(one.parameters)))
    found["least squares"] = [entry(LorentzianHead(target, steps=steps)) for steps in STEPS]
    found["network"] = [entry(network)]
    found["network, then least squares"] = [entry(Refined(lambda: network, steps=steps)) for steps in STEPS]
    return found


def drawn(rows: Sequence[Row]) -> None:
    figure = titled_figure((7, 5), "Ten lines' parameters of a real slice: error against run time", False)
    axis = figure.subplots()
    for (name, label), colour, marker in zip(LEGEND.items(), (GREY, BLUE, RED, GREEN), "osD^", strict=True):
        own = [row for row in rows if row["method"] == name]
        spent, error = (np.array([row[key] for row in own], dtype=float) for key in ("ms", "median"))
        axis.plot(spent, np.maximum(error, LEAST), marker=marker, color=colour, label=label)
    axis.axhline(1, color=GREY, linestyle=":", zorder=0, label="one standard error of least squares")
    axis.set(xscale="log", yscale="log", xlabel="processor time (ms a voxel, one core)")
    axis.set_ylabel(f"median |error| (standard errors of least squares;\nless than {LEAST:g} is drawn there)")
    axis.grid(alpha=0.3)
    axis.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    save_figure(figure, HERE, True)


def mapped(network: Predictor, data: CEST, file: Path) -> None:
    volume, names = read_volume(file), data.parameters.target
    inputs = torch.from_numpy(volume.spectra.astype(np.float32))
    models = {
        "least squares": LorentzianHead(Target("real", names)),
        "network": network,
        "network, then\nleast squares": Refined(lambda: network),
    }
    methods = {}
    for name, model in models.items():
        with torch.no_grad():
            parts = [(density.mean, density.stddev) for density in map(model, inputs.split(BLOCK))]
        point, deviation = (torch.cat(part).double().numpy() for part in zip(*parts, strict=True))
        methods[name] = slice_of(maps_of(volume, names, point, deviation), volume)
    figure = maps_figure(methods, f"{file.name}: amplitudes of the lines")
    path = save_figure(figure, HERE.with_name("cest_maps"), True)
    Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)  # a third of the bytes


@torch.no_grad()
def doubts(network: Predictor, data: CEST, test: dict[str, Tensor]) -> Iterator[dict[str, object]]:
    """By how much the predicted standard deviations rise where spectra are unlike those seen."""
    generator = torch.Generator().manual_seed(0)
    offsets, lines, inputs = torch.tensor(data.offsets), test["lines"], test["input"]
    plain, target = network(inputs).stddev, test["target"]
    cases = {"as measured": inputs}
    for noise in (0.01, 0.02):
        cases[f"noise {noise} added"] = inputs + noise * torch.randn(inputs.shape, generator=generator)
    for shift in (0.05, 0.1, 0.2):
        moved = lines.clone()
        moved[:, 2 * COUNT] += shift
        cases[f"shifted by {shift} ppm"] = inputs + spectrum(moved, offsets) - spectrum(lines, offsets)
    for name, some in cases.items():
        density = network(some)
        error = (density.mean - target).abs()
        yield {
            "case": name,
            "rise": float((density.stddev / plain).log().mean().exp()),
            "error": float(
                (error.mean(0) / (network(inputs).mean - target).abs().mean(0)).log().mean().exp()
            ),
            "cover": f"{100 * float((error < 1.6449 * density.stddev).double().mean()):.1f} %",
        }


FIRST = "## Batched least squares against SciPy, the whole slice"


def speeds(file: Path) -> str:
    """The section with the speed of SciPy and of all voxels at once."""
    return f"""{markdown(list(agreement(file)), AGREEMENT)}

Median of {ROUNDS} rounds (least to largest); in each, SciPy has another fifth of the voxels to 1e-14 and a twentieth to
1e-8, and all voxels are fitted at once. Within 1e-6: |difference| ≤ 1e-6 of the number, or of 1 % of its box where that
is more. Fifteen numbers are fitted from two starts and the better fit is kept; SciPy has the first of them.

{machine("torch", "scipy", "numpy")} Command: `python -m benchmarks.spectra.cest --only speed brain7T.mat`."""


def main() -> None:
    torch.set_num_threads(1)
    require_idle()
    loaded = [load_with_description(path) for path in sys.argv[1:]]
    networks = [network for network, _ in loaded]
    data = CEST(root=loaded[0][1].config["data"]["root"])
    data.prepare()
    file = Path(str(data.root))
    train, validation, test = (dict(part.fields) for part in data.splits())  # type: ignore[attr-defined]
    volume = read_volume(file)
    inputs = torch.from_numpy(volume.spectra.astype(np.float32))
    voxels, network = voxels_of(data, test), networks[0]
    found = curves(network, data, inputs, test, voxels)
    points = [
        {"method": name, "ms": ms, "median": off, "within": share}
        for name, several in found.items()
        for ms, off, share in several
    ]
    write_csv(points, None, HERE.with_suffix(".csv"))
    drawn(points)
    mapped(network, data, file)
    scipy = found["SciPy"][-1][0]
    named = [(name, points[-1]) for name, points in found.items()]
    few = next(point for point in found["network, then least squares"] if point[1] < 1e-3)
    named.append(("the same, stopped where the median is below 0.001", few))
    methods = [
        {"method": name, "ms": ms, "times": scipy / ms, "median": off, "within": f"{100 * share:.1f} %"}
        for name, (ms, off, share) in named
    ]
    numbers, shares = [], []
    before, after, mixed = [], [], []
    for one in networks:
        with torch.no_grad():
            density = one(test["input"])
        off = (density.mean - test["target"]).abs()
        shares.append(voxels.within(density.mean))
        before.append((off < 1.6449 * density.stddev).double().mean(0))
        after.append(conformal_coverage(one, validation, test))
        mixed.append(conformal_coverage(one, *halves(test)))
    density = network(test["input"])
    off = (density.mean.detach().double() - voxels.target).abs()
    for number, name in enumerate(data.parameters.target):
        told = voxels.determined[:, number]
        ratio = (off / voxels.error)[told, number]
        numbers.append(
            {
                "name": name,
                "determined": f"{100 * float(told.double().mean()):.1f} %",
                "error": float(voxels.error[:, number].median()),
                "off": float(off[:, number].median()),
                "within": f"{100 * float((ratio < 1).double().mean()):.1f} %",
                "before": " / ".join(f"{100 * float(part[number]):.1f}" for part in before),
                "after": " / ".join(f"{100 * float(part[number]):.1f}" for part in after),
                "mixed": " / ".join(f"{100 * float(part[number]):.1f}" for part in mixed),
            }
        )
    coverage = {
        what: " / ".join(f"{100 * float(part.mean()):.1f}" for part in parts)
        for what, parts in (("before", before), ("after", after), ("mixed", mixed))
    }
    doubted = list(doubts(network, data, test))
    told = f"{100 * float(voxels.determined.double().mean()):.1f} %"
    row = "| {name} | {determined} | {error:.4f} | {off:.4f} | {within} | {before} | {after} | {mixed} |"
    lines = [row.format(**each) for each in numbers]
    text = f"""# Lorentzian lines in a real brain slice

{len(inputs):,} voxels of `{file.name}` (7 T, 93 offsets; {volume.dropped} voxels that are not finite left out), one
core, processor time. Networks saw {len(train["input"])} voxels, {len(test["input"])} are held out in bands of rows
(`plugins/data/cest/README.md`). SciPy: `optimize.least_squares` (trf, bounds, x_scale="jac"), one voxel after another,
with residuals and an analytic Jacobian in lean NumPy. Commands in `cest.py`.

{FIRST}

{speeds(file)}

## Error against run time, ten numbers

![error against run time](cest.png)

{markdown(methods, METHODS)}

Errors are those of held-out voxels against converged least squares, in its standard errors, over the numbers that the
data determine: standard error below {100 * DETERMINED:.0f} % of the box's side, and not at a bound. Within one standard
error, networks of {len(networks)} seeds: {" / ".join(f"{100 * share:.1f} %" for share in shares)}. What least
squares say of themselves is not judged: the targets are their answers. All are given the whole slice at once.

| number | determined | standard error | its error | within | 90 % intervals cover | calibrated elsewhere | on others |
|---|---|---|---|---|---|---|---|
{chr(10).join(lines)}
| all | {told} | | | | {coverage["before"]} | {coverage["after"]} | {coverage["mixed"]} |

Medians, and shares by seed. Calibrated by `conformal` (score=mass) about each number's marginal: elsewhere, on the
validation split's bands of rows, where there is other tissue, so that nothing is promised; on others, a random half of
the test split, the other half of which is judged.

## What the network doubts

{markdown(doubted, DOUBTS)}

## Maps

![maps](cest_maps.png)

{machine("torch", "scipy", "numpy")}
"""
    write_page(HERE, text)
    sys.stdout.write(text)


if __name__ == "__main__":
    if sys.argv[1:] == ["--draw"]:
        drawn(read_rows(HERE.with_suffix(".csv")))
    elif sys.argv[1:3] == ["--only", "speed"]:
        torch.set_num_threads(1)
        require_idle()
        replace_section(HERE.with_suffix(".md"), FIRST, speeds(Path(sys.argv[3])))
    else:
        main()
