"""Compare fits of Lorentzian lines in a real brain slice: SciPy, batched least squares, a network, and both combined.

    for seed in 0 1 2; do python -m framework experiment=cest/mlp data.root=/path/to/brain7T.mat seed=$seed threads=1 \\
        pictures=false logger=none hydra.run.dir=outputs/cest/$seed; done
    python -m benchmarks.spectra.cest outputs/cest/0 outputs/cest/1 outputs/cest/2

The script measures processor time on one thread. It writes cest.md, cest.csv, cest.png and cest_maps.png beside this
file. With `--draw` it draws cest.png again from cest.csv. With `--only speed brain7T.mat` it writes only the first
section, which takes four minutes and needs no networks.
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from benchmarks.pages import machine, publish, read_rows, replace_section
from benchmarks.spectra.cest_scipy import AGREEMENT, TIGHT, compare_with_scipy, fit_with_scipy, time_call
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
"""Largest standard error of a parameter that the data determine, as a share of the parameter's permitted range."""
BLOCK = 512
METHODS = {
    "method": "method",
    "ms": "time a voxel, ms",
    "times": "speed ratio to SciPy",
    "median": "median error, standard errors",
    "within": "errors below one standard error",
}
CHANGED_SPECTRA = {
    "case": "held-out spectra",
    "rise": "σ ratio",
    "error": "error ratio",
    "cover": "coverage",
}
TABLE_HEAD = (
    "| parameter | determined | standard error | network error | below standard error | coverage, not calibrated | "
    "coverage, calibrated on the validation split | coverage, calibrated on half of the test split |"
)


LEGEND = {
    "SciPy": "SciPy, at most so many evaluations",
    "least squares": "batched least squares, at most so many steps",
    "network": "network",
    "network, then least squares": "network, then so many steps of least squares",
}
LEAST = 1e-8
"""Smallest error in the figure; smaller errors are drawn at this value."""


@torch.no_grad()
def predict_means(model: Callable[[Tensor], torch.distributions.Distribution], inputs: Tensor) -> Tensor:
    return model(inputs).mean


class SingleParameter(Predictor):
    """Predictor of the marginal density of one parameter, so that conformal prediction can calibrate it alone."""

    def __init__(self, model: Predictor, number: int) -> None:
        super().__init__()
        self.model, self.number = model, number

    def forward(self, inputs: Tensor) -> torch.distributions.Distribution:
        return marginal(self.model(inputs), self.number)

    loss = training_densities = calibrate = lambda self, *_: None  # type: ignore[assignment]


def batches(fields: dict[str, Tensor], number: int) -> list[Batch]:
    """Return the batches of a split, with one parameter as the target."""
    target = fields["target"][:, number : number + 1]
    both = zip(fields["input"].split(BLOCK), target.split(BLOCK), strict=True)
    return [{"input": inputs, "target": labels} for inputs, labels in both]


def split_in_halves(fields: dict[str, Tensor]) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Divide a split at random into two halves."""
    order = torch.randperm(len(fields["input"]), generator=torch.Generator().manual_seed(0))
    first, second = order.chunk(2)
    return tuple({name: tensor[rows] for name, tensor in fields.items()} for rows in (first, second))  # type: ignore[return-value]


@torch.no_grad()
def conformal_coverage(model: Predictor, validation: dict[str, Tensor], test: dict[str, Tensor]) -> Tensor:
    """Return, for each parameter, the share of test targets in its calibrated 90 % intervals."""
    shares = []
    for number in range(test["target"].shape[1]):
        wrapped = Conformal(
            lambda number=number: SingleParameter(model, number),
            Target("real", ("parameter",)),
            miscoverage=0.1,
            score="mass",
        )
        wrapped.calibrate(batches(validation, number))
        inside = [wrapped(batch["input"]).contains(batch["target"]) for batch in batches(test, number)]
        shares.append(torch.cat(inside).double().mean())
    return torch.stack(shares)


class Voxels(NamedTuple):
    """Test split, fitted by least squares.

    Attributes:
        target: (voxel, parameter), fitted parameters.
        error: (voxel, parameter), standard errors of the fit.
        determined: (voxel, parameter), whether the data determine a parameter.
    """

    target: Tensor
    error: Tensor
    determined: Tensor

    def median(self, estimates: Tensor | np.ndarray) -> float:
        """Return the median error, in standard errors."""
        return float(self.ratios(estimates).median())

    def within(self, estimates: Tensor | np.ndarray) -> float:
        """Return the share of errors below one standard error."""
        return float((self.ratios(estimates) < 1).double().mean())

    def ratios(self, estimates: Tensor | np.ndarray) -> Tensor:
        """Return the errors of all determined parameters, in standard errors."""
        errors = (torch.as_tensor(estimates).double()[:, : self.target.shape[1]] - self.target).abs()
        return (errors / self.error)[self.determined]


def fit_voxels(data: CEST, test: dict[str, Tensor]) -> Voxels:
    """Fit the test split by least squares."""
    parameters = data.parameters
    fitted = fit(test["input"], torch.tensor(data.offsets, dtype=torch.float64), parameters)
    columns = slice(parameters.target_count)
    lower, upper = (torch.tensor(side[columns]).double() for side in (parameters.lower, parameters.upper))
    target, error = fitted.parameters[:, columns], fitted.root.square().sum(-1).sqrt()[:, columns]
    inside = (target > lower + 1e-9) & (target < upper - 1e-9)
    return Voxels(target, error, inside & (error < DETERMINED * (upper - lower)))


def curves(
    network: Predictor, data: CEST, inputs: Tensor, test: dict[str, Tensor], voxels: Voxels
) -> dict[str, list[tuple[float, float, float]]]:
    """Return results by method, one for each value of its knob.

    A result is the time a voxel (ms), the median error in standard errors, and the share of errors below one standard
    error.
    """
    target = Target("real", data.parameters.target)

    def evaluate(model: Predictor | LorentzianHead) -> tuple[float, float, float]:
        _, spent = time_call(lambda: predict_means(model, inputs), len(inputs))
        estimates = predict_means(model, test["input"])
        return spent, voxels.median(estimates), voxels.within(estimates)

    results: dict[str, list[tuple[float, float, float]]] = {"SciPy": []}
    for most in (*STEPS[:-1], 20, None):
        fitted = fit_with_scipy(
            test["input"][::3].double().numpy(), np.array(data.offsets), data.parameters, TIGHT, most
        )
        subset = Voxels(*(part[::3] for part in voxels))
        results["SciPy"].append(
            (fitted.milliseconds, subset.median(fitted.parameters), subset.within(fitted.parameters))
        )
    results["least squares"] = [evaluate(LorentzianHead(target, steps=steps)) for steps in STEPS]
    results["network"] = [evaluate(network)]
    results["network, then least squares"] = [
        evaluate(Refined(lambda: network, steps=steps)) for steps in STEPS
    ]
    return results


def draw_curves(rows: Sequence[Row]) -> None:
    """Save the figure of error against run time."""
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


def draw_maps(network: Predictor, data: CEST, file: Path) -> None:
    """Save the maps of the amplitudes by three methods."""
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
    # 256 colours reduce the file to a third of its size
    Image.open(path).convert("RGB").quantize(256).save(path, optimize=True)


@torch.no_grad()
def change_spectra(network: Predictor, data: CEST, test: dict[str, Tensor]) -> Iterator[dict[str, object]]:
    """Yield table rows: by how much the predicted standard deviations and the errors rise for changed spectra."""
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
    for name, spectra in cases.items():
        density = network(spectra)
        error = (density.mean - target).abs()
        yield {
            "case": name,
            "rise": float((density.stddev / plain).log().mean().exp()),
            "error": float(
                (error.mean(0) / (network(inputs).mean - target).abs().mean(0)).log().mean().exp()
            ),
            "cover": f"{100 * float((error < 1.6449 * density.stddev).double().mean()):.1f} %",
        }


FIRST = "## Batched least squares compared with SciPy"


def speed_section(file: Path) -> str:
    """Return the section that compares SciPy with the batched fit."""
    return f"""This table compares the least-squares fit of SciPy with the batched least squares of this project, which
fits the spectra of all voxels at once. The model has 11 or 15 parameters. SciPy runs with the tolerance 1e-14 and with
its default 1e-8. The three columns after the number of parameters hold milliseconds a voxel: the median of {ROUNDS}
rounds (least to largest). In each round SciPy fits another fifth of the voxels with 1e-14 and a twentieth of the
voxels with 1e-8, and the batched fit has all voxels. A speed ratio is SciPy's time divided by the time of the batched
fit. `whole slice` is the time of the batched fit for all voxels.

The last five columns of the table compare the batched fits of the spectra with SciPy's fits at the tolerance 1e-14.
`sum of squares ≤ SciPy's` is the share of voxels where the batched fit is at least as good. `same minimum` is the
share of voxels where the parameters are well determined and both sums of squares agree. `parameters agree` is the
share of these where every parameter agrees to 1e-6: the difference is at most 1e-6 of the parameter, or 1e-6 of 1 %
of its permitted range if that is larger. Of the voxels with the
same minimum where a parameter differs by more, `batched nearer` is the share where the
batched fit is nearer to the minimum. `warnings` is the number of voxels for which the batched fit reports a problem.

With 15 parameters per spectrum, the batched fit of this project starts from two sets of starting values and keeps the
better result. SciPy starts from the first set only.

{markdown(list(compare_with_scipy(file)), AGREEMENT)}

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
    voxels, network = fit_voxels(data, test), networks[0]
    results = curves(network, data, inputs, test, voxels)
    points = [
        {"method": name, "ms": ms, "median": off, "within": share}
        for name, several in results.items()
        for ms, off, share in several
    ]
    write_csv(points, None, HERE.with_suffix(".csv"))
    draw_curves(points)
    draw_maps(network, data, file)
    scipy = results["SciPy"][-1][0]
    methods_shown = [(name, points[-1]) for name, points in results.items()]
    stopped = next(point for point in results["network, then least squares"] if point[1] < 1e-3)
    methods_shown.append(("the same, stopped where the median is below 0.001", stopped))
    methods = [
        {"method": name, "ms": ms, "times": scipy / ms, "median": off, "within": f"{100 * share:.1f} %"}
        for name, (ms, off, share) in methods_shown
    ]
    numbers, shares = [], []
    before, after, mixed = [], [], []
    for trained in networks:
        with torch.no_grad():
            density = trained(test["input"])
        errors = (density.mean - test["target"]).abs()
        shares.append(voxels.within(density.mean))
        before.append((errors < 1.6449 * density.stddev).double().mean(0))
        after.append(conformal_coverage(trained, validation, test))
        mixed.append(conformal_coverage(trained, *split_in_halves(test)))
    density = network(test["input"])
    errors = (density.mean.detach().double() - voxels.target).abs()
    for number, name in enumerate(data.parameters.target):
        determined = voxels.determined[:, number]
        ratio = (errors / voxels.error)[determined, number]
        numbers.append(
            {
                "name": name,
                "determined": f"{100 * float(determined.double().mean()):.1f} %",
                "error": float(voxels.error[:, number].median()),
                "off": float(errors[:, number].median()),
                "within": f"{100 * float((ratio < 1).double().mean()):.1f} %",
                "before": " / ".join(f"{100 * float(part[number]):.1f}" for part in before),
                "after": " / ".join(f"{100 * float(part[number]):.1f}" for part in after),
                "mixed": " / ".join(f"{100 * float(part[number]):.1f}" for part in mixed),
            }
        )
    coverage = {
        column: " / ".join(f"{100 * float(part.mean()):.1f}" for part in parts)
        for column, parts in (("before", before), ("after", after), ("mixed", mixed))
    }
    changed = list(change_spectra(network, data, test))
    determined = f"{100 * float(voxels.determined.double().mean()):.1f} %"
    row = "| {name} | {determined} | {error:.4f} | {off:.4f} | {within} | {before} | {after} | {mixed} |"
    lines = [row.format(**line) for line in numbers]
    text = f"""# Lorentzian lines in a real brain slice

A CEST image (chemical exchange saturation transfer, a kind of magnetic resonance imaging) holds one spectrum for each
voxel. This page compares two ways to fit five Lorentzian lines to each spectrum of a real brain slice: least squares
and a neural network. It shows how fast and how exact each of them is. `plugins/data/cest/README.md` describes the data
and the model of the spectra.

The brain slice has {len(inputs):,} voxels with one spectrum each (`{file.name}`, 7 T, 93 offsets).
Another {volume.dropped} voxels are left out, because their spectra hold numbers that are not finite. The networks
were trained on {len(train["input"])} voxels and are tested on {len(test["input"])} other voxels, in separate
bands of rows. All times are processor times on one core. SciPy means `optimize.least_squares` (trf, bounds,
x_scale="jac"). It fits one voxel after another, with residuals and an analytic Jacobian in NumPy that compute nothing
twice. The commands are in `cest.py`.

{FIRST}

{speed_section(file)}

## Error against run time

This table and the figure hold the errors of the ten fitted parameters, five amplitudes and five widths of lines, in
held-out voxels. An error is the distance from the converged least-squares fit, divided by the standard error of that
fit. Only parameters that the data determine are counted: the standard error is below {100 * DETERMINED:.0f} % of the
permitted range, and the parameter is not at the border of this range. `time a voxel` is measured with the whole slice
at once, except for SciPy. The column `speed ratio to SciPy` is the time of SciPy divided by the time of the method. The
last column is the share of errors below one standard error. For the networks of {len(networks)} seeds this share is
{" / ".join(f"{100 * share:.1f} %" for share in shares)}. The small errors of least squares are not evidence of
accuracy, because the targets are themselves least-squares fits.

![Error of the parameters against run time](cest.png)

{markdown(methods, METHODS)}

Each row of the table is one parameter of the Lorentzian lines that are fitted to the spectra. `determined` is the
share of voxels whose data determine the parameter. `standard error` is the median standard error of least squares,
and `network error` is the median absolute error of the network; both are in the unit of the parameter.
`below standard error` is the share of determined parameters for which the network error is smaller than the standard
error. These columns are for the first network. The last three columns hold the coverage of the predicted 90 %
intervals in %, for each of the networks: without calibration, after calibration on the validation split, and after
calibration on the test split.

{TABLE_HEAD}
|---|---|---|---|---|---|---|---|
{chr(10).join(lines)}
| all | {determined} | | | | {coverage["before"]} | {coverage["after"]} | {coverage["mixed"]} |

The predicted 90 % intervals of the parameters are calibrated with `conformal` (score=mass) for each parameter
separately. The voxels of the brain slice are split by bands of neighbouring rows. The bands of the validation split
therefore show other tissue than the bands of the test split, and conformal prediction does not guarantee the coverage
for the test split. For the last column of the table, a random half of the test split is used for calibration and the
other half for the test.

## Predicted uncertainty for unusual spectra

The standard deviation σ that the network predicts for a parameter should increase if a spectrum is unlike the
training spectra. For this table the held-out spectra were changed: noise with the given standard deviation was added,
or the lines were shifted along the axis of the offsets. `σ ratio` is the predicted σ divided by the predicted σ for
the unchanged spectra, and `error ratio` is the same ratio of the mean absolute errors; both are geometric means.
`coverage` is the share of targets in the predicted 90 % intervals. If σ rises less than the error, the coverage
falls.

{markdown(changed, CHANGED_SPECTRA)}

## Maps

The maps in the figure show the amplitudes of the fitted lines in the whole slice, as computed by least squares, by
the network, and by least squares that start from the network.

![Maps of the amplitudes](cest_maps.png)

{machine("torch", "scipy", "numpy")}
"""
    publish(HERE, text)


if __name__ == "__main__":
    if sys.argv[1:] == ["--draw"]:
        draw_curves(read_rows(HERE.with_suffix(".csv")))
    elif sys.argv[1:3] == ["--only", "speed"]:
        torch.set_num_threads(1)
        require_idle()
        replace_section(HERE.with_suffix(".md"), FIRST, speed_section(Path(sys.argv[3])))
    else:
        main()
