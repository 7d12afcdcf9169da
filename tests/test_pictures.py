"""Content of figures: scales, texts and numbers of elements, read from matplotlib's artists."""

import math
import re
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Polygon
from matplotlib.text import Annotation, Text
from scipy.special import logsumexp
from scipy.stats import vonmises

from framework.distributions.density import Mixture
from framework.figures.style import save_figure, titled_figure
from framework.reports.interval_picture import Intervals, draw_intervals
from framework.reports.prediction_pictures import deviation, log_density_on_circle
from framework.reports.table import aggregate
from framework.reports.tradeoff_picture import Floor, error_against_run_time
from framework.reports.training_curve import training_curve
from framework.reports.viewing_circles import RING, choose, count_peaks, outer_density, viewing_circles
from framework.sweeps import comparison
from framework.sweeps.results import Comparison, comparison_figure
from plugins.density_head.von_mises.density import VonMises

ANGLES = -math.pi + 2 * math.pi / 720 * np.arange(720)


def bumps(*parts: tuple[float, float, float]) -> np.ndarray:
    """Return the log-density of a mixture of (weight, mean, concentration) on the grid."""
    logs = [math.log(weight) + vonmises.logpdf(ANGLES, sharp, loc=mean) for weight, mean, sharp in parts]
    return logsumexp(logs, axis=0)


def words(figure: Figure) -> str:
    found = [text.get_text() for text in figure.findobj(Text)]
    return "\n".join(found).replace("\n", " ")


def drawn(figure: Figure, folder: Path) -> None:
    """Render a figure, since missing glyphs and layouts that do not fit raise errors only then."""
    figure.savefig(folder / "figure.png", dpi=60)
    assert (folder / "figure.png").stat().st_size > 2000


# choosing samples


def test_peaks_are_counted_around_the_circle() -> None:
    densities = [
        bumps((1, 0, 5)),
        bumps((1, math.pi, 50)),  # across the end of the grid
        bumps((0.5, 0, 20), (0.5, math.pi, 20)),
        bumps((0.9, 0, 20), (0.1, math.pi, 20)),  # a ninth of the height does not count
        bumps((0.3, -2, 30), (0.3, 0, 30), (0.4, 2, 30)),
        np.full(720, -math.log(2 * math.pi)),
        np.where(np.arange(720) == 7, 3.0, -math.inf),
    ]
    assert count_peaks(np.array(densities).T).tolist() == [1, 1, 2, 1, 3, 1, 1]


def test_rows_are_the_certain_the_ambiguous_and_the_confident_mistakes() -> None:
    one, two = bumps((1, 0, 50)), bumps((0.5, 0, 50), (0.5, math.pi, 50))
    entropy = np.array([-1.0, -2.0, 1.8, -1.5, 0.5, 0.1, 1.7, 1.6])
    error = np.radians([5.0, 3.0, 2.0, 170.0, 4.0, 90.0, 100.0, 31.0])
    log_density = np.array([one, one, one, one, two, two, one, one]).T
    assert choose(entropy, error, log_density) == {"certain": [1, 0], "ambiguous": [5, 4], "failed": [3]}
    assert choose(entropy, error, log_density, count=1) == {"certain": [1], "ambiguous": [5], "failed": [3]}


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 40), st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_chosen_samples_are_few_distinct_and_the_same_again(samples: int, count: int, seed: int) -> None:
    generator = np.random.default_rng(seed)
    entropy = generator.integers(-3, 3, samples).astype(float)  # many ties
    error = generator.uniform(0, math.pi, samples)
    log_density = generator.normal(0, 2, (24, samples))
    found = choose(entropy, error, log_density, count)
    everything = [index for row in found.values() for index in row]
    assert list(found) == ["certain", "ambiguous", "failed"]
    assert len(set(everything)) == len(everything)
    assert all(len(row) <= count for row in found.values())
    assert all(error[index] <= math.pi / 6 for index in found["certain"])
    assert all(error[index] > math.pi / 6 for index in found["failed"])
    assert choose(entropy, error, log_density, count) == found


def test_samples_that_cannot_be_compared_are_refused() -> None:
    one = bumps((1, 0, 5))[:, None]
    with pytest.raises(ValueError, match="NaN"):
        choose(np.array([math.nan]), np.zeros(1), one)


@settings(deadline=None, max_examples=60)
@given(st.floats(-4, 4), st.floats(-4, 4), st.integers(0, 5))
def test_an_error_is_to_the_nearest_true_angle(truth: float, point: float, symmetry: int) -> None:
    """Compare with a loop over all true angles; if every angle is true, the error is 0."""
    found = deviation(
        *(torch.tensor([value], dtype=torch.float64) for value in (truth, point)), torch.tensor([symmetry])
    )
    turns = [truth + 2 * math.pi * turn / max(symmetry, 1) for turn in range(symmetry)] or [point]
    wanted = min(abs(math.remainder(true - point, 2 * math.pi)) for true in turns)
    assert found.item() == pytest.approx(wanted, abs=1e-12)


# viewing circles


def circles(densities: list[np.ndarray], **changed) -> Figure:
    count = len(densities)
    arguments = {
        "images": [np.full((12, 20 + index, 3), 90, np.uint8) for index in range(count)],
        "log_density": np.array(densities).T,
        "angles": ANGLES,
        "truths": np.linspace(0, 3, count),
        "predictions": np.linspace(0.1, 2, count),
        "captions": [f"sample {index}" for index in range(count)],
        "rows": {"certain": count, "failed": 0},
        "title": "Densities",
        "synthetic": True,
    }
    return viewing_circles(**(arguments | changed))


def band(figure: Figure, panel: int = 0) -> np.ndarray:
    """Return the corners of the band that shows the density."""
    (polygon,) = [patch for patch in figure.axes[panel].patches if isinstance(patch, Polygon)]
    return polygon.get_xy()


def test_each_sample_has_its_image_band_truth_and_prediction(tmp_path: Path) -> None:
    figure = circles([bumps((1, 0, 5))] * 4)
    filled = [axes for axes in figure.axes if axes.images]
    assert len(filled) == 4
    assert [axes.get_xlabel() for axes in filled] == [f"sample {index}" for index in range(4)]
    text = words(figure)
    for word in ("0°", "90°", "180°", "270°", "certain", "failed", "no such sample"):
        assert word in text
    for word in ("predicted density", "truth", "point prediction", "uniform density", "counter-clockwise"):
        assert text.count(word) == 1  # the legend stands once
    assert "equally true" not in text
    assert text.count("Failed: one peak, sharper than half of all, more than 30° off.") == 1
    assert "Failed: one peak" not in words(circles([bumps((1, 0, 5))], rows={"certain": 1}))
    assert "Densities (synthetic data)" in text
    drawn(figure, tmp_path)


@pytest.mark.parametrize(
    ("angle", "place"), [(0.0, (0, -1)), (math.pi / 2, (1, 0)), (math.pi, (0, 1)), (-math.pi / 2, (-1, 0))]
)
def test_angle_zero_is_at_the_bottom_and_angles_grow_counter_clockwise(
    angle: float, place: tuple[float, float]
) -> None:
    figure = circles([bumps((1, angle, 2))], truths=np.array([angle]), predictions=np.array([angle]))
    corners = band(figure)
    farthest = corners[np.hypot(*corners.T).argmax()]
    assert farthest / np.hypot(*farthest) == pytest.approx(place, abs=0.01)
    marks = [line for line in figure.axes[0].lines if len(line.get_xdata()) <= 2]
    for mark in marks:  # truth and prediction
        end = np.array([mark.get_xdata()[-1], mark.get_ydata()[-1]])
        assert end / np.hypot(*end) == pytest.approx(place, abs=1e-6)
    assert len(marks) == 2


WORDS = ("ahead", "port", "astern", "starboard")


@pytest.mark.parametrize("directions", [(), WORDS])
def test_words_stand_where_their_angles_are(directions: tuple[str, ...]) -> None:
    """Directions have the names that the data set gives, or degrees; no other names are shown."""
    figure = circles([bumps((1, 0, 5))], directions=directions)
    where = {text.get_text(): text.get_position() for text in figure.axes[0].texts}
    bottom, right, top, left = directions or ("0°", "90°", "180°", "270°")
    assert where[bottom][1] < -0.5 and where[top][1] > 0.5
    assert where[right][0] > 0.5 and where[left][0] < -0.5
    assert ("The object from above: ahead (0°) is at the bottom" in words(figure)) is bool(directions)
    assert "0° is at the bottom, angles turn counter-clockwise" in words(figure).replace("(0°)", "0°")
    assert not {"front", "back", "left", "right"} & set(words(figure).split())


def test_thickness_is_the_density_whose_scale_each_panel_says() -> None:
    """No peak is cut off, however sharp; in panels of one scale, equal heights mean equal densities."""
    sharpness = (0, 4, 8, 400, 1e4)
    figure = circles([bumps((1, ANGLES[500], sharp)) for sharp in sharpness])
    for axes, sharp, outer in zip(figure.axes, sharpness, (1.5, 1.5, 1.5, 15, 60), strict=False):
        (patch,) = [patch for patch in axes.patches if isinstance(patch, Polygon)]
        radius = np.hypot(*patch.get_xy().T)
        assert radius.max() == pytest.approx(1 + RING * vonmises.pdf(0, sharp) / outer, rel=1e-3)
        assert radius.min() == pytest.approx(1)
        assert f"{outer:g} per rad" in [text.get_text() for text in axes.texts]
    assert "outer circle: the density written there" in words(figure)


@pytest.mark.parametrize("peak", [0.0, 1.5, 1.6, 5.1, 14.9, 15.1, 40.0, 1e9, math.exp(700)])
def test_a_scale_holds_its_peak_and_is_not_much_larger(peak: float) -> None:
    assert peak <= outer_density(peak) <= max(1.5, 2.6 * peak)


@pytest.mark.parametrize(
    "parts",
    [
        [(1, 1.0, 4)],
        [(1, 1.0 + 0.004, 1e4)],
        [(1, 1.0 + 0.004, 1e8)],
        [(1, -math.pi, 1e12)],
        [(0.5, 1.004, 1e9), (0.5, -1, 3)],
        [(0.3, 1.004, 1e9), (0.7, 2.008, 1e7)],
    ],
)
def test_no_density_falls_between_the_angles_where_it_is_drawn(
    parts: list[tuple[float, float, float]],
) -> None:
    """The total mass is 1, and the mass within 3° of each narrow peak is the weight of that peak."""
    weight, mean, sharp = torch.tensor(parts, dtype=torch.float64)[None].unbind(-1)  # of a batch of one
    density = Mixture(weight.log(), VonMises(mean[..., None], sharp[..., None]))
    torch.manual_seed(0)
    angles, log_density = log_density_on_circle(density)
    mass = log_density.exp()[:, 0].numpy() * 2 * math.pi / len(angles)
    assert mass.sum() == pytest.approx(1, abs=0.02)
    for share, middle, concentration in parts:
        if concentration > 1e3:
            near = np.abs(np.angle(np.exp(1j * (angles.numpy() - middle)))) < 0.05
            assert mass[near].sum() == pytest.approx(share, abs=0.06)
    assert outer_density(float(log_density.exp().max())) <= 150


def test_every_equally_true_angle_is_marked(tmp_path: Path) -> None:
    modes = [np.array([0.0, 2.0, 4.0]), np.array([]), np.array([])]
    figure = circles([bumps((1, 0, 5))] * 3, modes=modes, truths=np.array([0.0, 1.0, math.nan]))
    triangles = [sum(isinstance(line.get_marker(), tuple) for line in axes.lines) for axes in figure.axes[:3]]
    assert triangles == [4, 1, 0]  # and the truth, where there is one
    assert "equally true" in words(figure)
    drawn(figure, tmp_path)


def test_a_density_at_one_angle_is_visible(tmp_path: Path) -> None:
    figure = circles([np.where(np.arange(720) == 3, 800.0, -math.inf)])
    (line,) = [line for line in figure.axes[0].lines if len(line.get_xdata()) > 700]
    assert line.get_linewidth() > 0  # a band would have no area
    assert 1 + 0.39 * RING < np.hypot(*line.get_xydata().T).max() <= 1 + RING
    drawn(figure, tmp_path)


def test_wild_captions_are_printed_as_they_are(tmp_path: Path) -> None:
    figure = circles(
        [bumps((1, 0, 5))], captions=["$cost$_{x} \\frac\nsecond line"], title="$title$", synthetic=False
    )
    assert "$cost$_{x} \\frac second line" in words(figure)
    assert "synthetic" not in words(figure)
    drawn(figure, tmp_path)


def test_no_samples_at_all_still_make_a_figure(tmp_path: Path) -> None:
    empty = {"log_density": np.zeros((720, 0)), "truths": np.zeros(0), "predictions": np.zeros(0)}
    drawn(circles([], **empty, rows={"certain": 0, "ambiguous": 0, "failed": 0}), tmp_path)


def test_wrong_numbers_of_samples_and_nan_are_refused() -> None:
    with pytest.raises(
        ValueError, match="1 densities, 1 images and 2 captions, and the numbers in `rows` sum to 1"
    ):
        circles([bumps((1, 0, 5))], captions=["one", "two"])
    with pytest.raises(ValueError, match="NaN"):
        circles([np.full(720, math.nan)])


# file formats

KINDS = {True: b"\x89PNG", False: b"\x89PNG", "png": b"\x89PNG", "pdf": b"%PDF", "svg": b"<?xml"}


@pytest.mark.parametrize("pictures", KINDS, ids=str)
def test_a_figure_is_saved_in_the_format_asked_for_and_the_same_again(
    pictures: bool | str, tmp_path: Path
) -> None:
    contents = []
    for again in range(2):
        (tmp_path / f"{again}.of two").mkdir()
        figure = titled_figure((3.0, 2.0), "a · b", True)
        figure.subplots().plot([1, 2], [3, 4])
        path = save_figure(figure, tmp_path / f"{again}.of two" / "curve", pictures)
        contents.append(path.read_bytes())
        assert path.name == f"curve.{pictures if isinstance(pictures, str) else 'png'}"
    assert contents[0] == contents[1] and contents[0].startswith(KINDS[pictures])


@pytest.mark.parametrize(
    "text", ["\x1b[31m", "\x00", "\ufffe", "\x85", "\u202eab", "\udce9", "--><x/>", "]]>", "&<", "a\nb"]
)
@pytest.mark.parametrize("pictures", ["svg", "pdf", "png"])
def test_a_name_of_another_person_breaks_no_figure(text: str, pictures: str, tmp_path: Path) -> None:
    figure = titled_figure((3.0, 2.0), text, False)
    axes = figure.subplots()
    axes.plot([0, 1], [0, 1], label=text)
    axes.legend()
    axes.set_title(text)
    axes.set_xlabel(text)
    axes.set_xticks([0, 1], [text, "b"])
    axes.annotate(text, (0, 0))
    path = save_figure(figure, tmp_path / "figure", pictures)  # a warning of matplotlib fails the test
    if pictures == "svg":
        tags = {element.tag.rpartition("}")[2] for element in ElementTree.parse(path).iter()}
        assert "svg" in tags and "x" not in tags and "script" not in tags


# training curves


def test_training_curve_shows_both_losses_and_the_kept_epoch(tmp_path: Path) -> None:
    figure = training_curve(
        [0.5, 1.0, 1.5], [3.0, 2.0, 1.0], [(1, 2.5), (2, 2.0)], best_epoch=2, title="run", synthetic=True
    )
    (axes,) = figure.axes
    train, validation, best = axes.lines
    assert train.get_xydata().tolist() == [[0.5, 3], [1, 2], [1.5, 1]]
    assert validation.get_xydata().tolist() == [[1, 2.5], [2, 2]]
    assert best.get_xdata() == [2, 2]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("epoch", "loss (nats per sample)")
    assert "run (synthetic data)" in words(figure) and "epoch 2" in words(figure)
    assert axes.get_yscale() == "linear"
    drawn(figure, tmp_path)


def test_one_wild_loss_does_not_flatten_the_others(tmp_path: Path) -> None:
    losses = [1.0] * 50 + [1e6] + [-1.0] * 50
    figure = training_curve(
        range(101), losses, [(100, math.nan)], best_epoch=None, title="run", synthetic=False
    )
    assert figure.axes[0].get_yscale() == "symlog"
    assert len(figure.axes[0].lines) == 2
    drawn(figure, tmp_path)


def test_nothing_recorded_is_an_empty_training_curve(tmp_path: Path) -> None:
    drawn(training_curve([], [], [], best_epoch=None, title="run", synthetic=False), tmp_path)


# error against run time along a knob


def curve(method: str, knob: str, points: list[tuple[float, float, float, float]]) -> list[dict]:
    """Rows of value, error, standard error and milliseconds."""
    keys = ("value", "error", "error_sem", "ms")
    return [{"method": method, "knob": knob, **dict(zip(keys, point, strict=True))} for point in points]


FIRST = curve("first", "samples", [(n, 0.5 / n, 0.1 / n, 1 + 0.01 * n) for n in (1, 10, 100)])
SECOND = curve("second", "tolerance", [(1e-3, 0.4, 0.01, 3.0), (1e-6, 0.0, 0.0, 9.0)])
CURVES = [*FIRST, *SECOND, *curve("third", "members", [(4, math.inf, math.nan, 0.5)])]


def diagram(rows: list[dict], **changed) -> Figure:
    options = {
        "better": {"error": "lower"},
        "title": "",
        "synthetic": False,
        "time": "ms",
        "machine": "cpu (X), 2 threads",
    }
    return error_against_run_time(rows, {"error": "error (nats)"}, **(options | changed))


def lines_with(figure: Figure, **wanted) -> list[Line2D]:
    return [
        line
        for line in figure.axes[0].lines
        if all(getattr(line, f"get_{k}")() == v for k, v in wanted.items())
    ]


def test_the_diagram_is_logarithmic_with_units_bars_and_knob_values(tmp_path: Path) -> None:
    floor = Floor(0.004, "below 0.004 nats the reference itself is uncertain")
    figure = diagram(CURVES, title="Diagram", synthetic=True, floors={"error": floor}, note="by hand")
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    assert "ms per sample" in axes.get_xlabel() and "nats" in axes.get_ylabel()
    assert len(axes.containers) == 2
    assert axes.containers[0].lines[0].get_xydata() == pytest.approx(
        np.array([(row["ms"], row["error"]) for row in FIRST])
    )
    notes = [text.get_text() for text in axes.texts if isinstance(text, Annotation)]
    assert notes == ["1", "10", "100", "0.001", "1e-06: error 0"]
    text = words(figure)
    assert "first (samples)" in text and "second (tolerance)" in text and "third" not in text
    assert text.count("by hand") == 1
    assert "below 0.004 nats the reference itself is uncertain" in text
    assert "not drawn, without finite error and run time: 1" in text
    assert "Diagram (synthetic data)" in text
    drawn(figure, tmp_path)


def test_rings_mark_the_pareto_points_of_all_methods() -> None:
    (rings,) = lines_with(diagram(CURVES), markersize=13)
    assert rings.get_xdata() == pytest.approx([row["ms"] for row in [*FIRST, SECOND[1]]])


def test_everything_drawn_stands_inside_the_axes_and_bars_show_standard_errors() -> None:
    axes = diagram(FIRST, floors={"error": Floor(1e-3, "uncertain")}).axes[0]
    (bars,) = axes.containers[0].lines[2]
    for row, (low, high) in zip(FIRST, bars.get_segments(), strict=True):
        assert high[1] - low[1] == pytest.approx(2 * row["error_sem"])
    bottom, top = axes.get_ylim()
    assert bottom < 1e-3 < top
    assert bottom < min(row["error"] for row in FIRST)


@pytest.mark.parametrize("height, seen", [(0.0, False), (1e-30, False), (1e-3, True), (2.0, True)])
def test_a_reference_known_to_rounding_does_not_stretch_the_diagram(height: float, seen: bool) -> None:
    axes = diagram(FIRST, floors={"error": Floor(height, "uncertain")}).axes[0]
    bottom, top = axes.get_ylim()
    assert bottom > 1e-5 and top > height
    assert bool(axes.patches) is seen


def test_narrow_errors_fill_their_panel_and_negative_ones_are_not_logarithmic() -> None:
    axes = diagram(curve("first", "members", [(1, 0.30, 0.01, 1.0), (2, 0.29, 0.01, 2.0)])).axes[0]
    bottom, top = axes.get_ylim()
    assert axes.get_yscale() == "log" and 0.25 < bottom < 0.28 and 0.31 < top < 0.33
    below_zero = curve("first", "members", [(1, 0.3, 0.01, 1.0), (2, -0.1, 0.01, 2.0)])
    assert diagram(below_zero).axes[0].get_yscale() == "linear"


def test_a_long_legend_leaves_the_panel_its_height() -> None:
    for methods in (2, 20, 45):
        rows = [
            {**FIRST[0], "method": f"a method with a long name, strength={number}"}
            for number in range(methods)
        ]
        figure = diagram(rows)
        height = figure.axes[0].get_position().height * figure.get_figheight()
        assert height > 2, f"{methods} methods leave {height:.2f} inches"


def test_several_numbers_have_a_panel_each(tmp_path: Path) -> None:
    rows = [{**row, "accuracy": 0.9, "nll": 0.1 * row["error"]} for row in FIRST]
    labels = {"error": "error", "accuracy": "accuracy", "nll": "NLL", "error_sem": "its error"}
    figure = error_against_run_time(
        rows,
        labels,
        {"error": "lower", "nll": "lower", "accuracy": "higher", "error_sem": "lower"},
        title="t",
        synthetic=True,
        time="ms",
        machine="cpu (X), 2 threads",
    )
    shown = [axes for axes in figure.axes if axes.get_visible()]
    assert [axes.get_ylabel() for axes in shown] == list(labels.values())
    assert {axes.get_xlabel() for axes in shown} == {"run time (ms per sample)\non cpu (X), 2 threads"}
    assert [axes.get_yscale() for axes in shown] == ["log", "linear", "log", "log"]
    assert figure.get_suptitle() == "t (synthetic data)"
    assert words(figure).count("first (samples)") == 1
    drawn(figure, tmp_path)


def test_knob_values_do_not_cover_each_other() -> None:
    points = [(value, 0.1 * (1 + 0.02 * value), 0.001, 1 + 0.002 * value) for value in range(1, 7)]
    figure = diagram([*curve("crowded", "samples", points), *FIRST])
    boxes = [text.get_window_extent() for text in figure.axes[0].texts if isinstance(text, Annotation)]
    assert len(boxes) == 9
    assert not any(box.overlaps(other) for index, box in enumerate(boxes) for other in boxes[:index])


@pytest.mark.parametrize(
    "points",
    [
        [],
        [(1, 0.0, 0.0, 1.0)],
        [(1, math.inf, math.nan, 1.0)],
        [(10**n, 10.0**-n, 0.0, 10.0**n) for n in range(9)],
        [(n, 0.5, 0.0, 2.0) for n in range(3)],
    ],
    ids=["nothing", "exact", "lost", "wide", "equal"],
)
def test_odd_diagrams_are_drawn(points: list[tuple[float, float, float, float]], tmp_path: Path) -> None:
    figure = diagram(curve("odd", "samples", points), title="odd")
    drawn(figure, tmp_path)
    assert all(re.fullmatch(r"[\d.e+-]*", label.get_text()) for label in figure.axes[0].get_xticklabels())


def test_a_narrow_range_of_times_still_has_ticks() -> None:
    points = [(n, 0.5 / n, 0.0, 1.1 + 0.01 * n) for n in (1, 2, 3)]
    axes = diagram(curve("first", "samples", points)).axes[0]
    low, high = axes.get_xlim()
    assert sum(low <= tick <= high for tick in axes.get_xticks()) >= 2


# results side by side

ROWS = [
    {"method": method, "class": name, "error": error, "error_std": 0.5, "n": 20, "ms": time}
    for method, name, error, time in [
        ("a", "car", 5.0, 1.0),
        ("b", "car", 4.0, 2.0),
        ("c", "car", 6.0, 3.0),
        ("a", "bus", 9.0, 1.0),
        ("b", "bus", 9.5, 2.0),
    ]
]


def test_comparison_gives_methods_colours_and_groups_markers(tmp_path: Path) -> None:
    rows = [*ROWS, {"method": "broken", "class": "car", "error": None, "ms": 1.0}]
    figure = diagram(rows, group="class", synthetic=True, title="Comparison")
    (axes,) = figure.axes
    assert (axes.get_xscale(), axes.get_yscale()) == ("log", "log")
    points = [container.lines[0] for container in axes.containers]
    assert len(points) == 5
    assert all(container.has_yerr for container in axes.containers)
    assert len({point.get_color() for point in points}) == 3
    assert len({point.get_marker() for point in points}) == 2
    assert points[0].get_color() == points[3].get_color() and points[0].get_marker() == points[1].get_marker()
    text = words(figure)
    for word in (
        "a",
        "b",
        "c",
        "car",
        "bus",
        "not beaten beyond noise in its class (Pareto)",
        "front: every difference significant at 95 %, Welch's t-test; run times within 5 % count as equal",
        "finite error and run time: 1",
        "(synthetic data)",
    ):
        assert word in text
    assert "broken" not in text
    drawn(figure, tmp_path)


def test_comparison_rings_the_front_of_each_group() -> None:
    figure = diagram(ROWS, group="class")
    rings = [line.get_xydata().tolist() for line in lines_with(figure, markersize=13)]
    assert rings == [[[1, 5], [2, 4]], [[1, 9]]]
    together = diagram(ROWS)
    assert [line.get_xydata().tolist() for line in lines_with(together, markersize=13)] == [[[1, 5], [2, 4]]]


@pytest.mark.parametrize("known", [True, False])
def test_without_standard_errors_nothing_is_ringed_and_the_panel_says_so(known: bool) -> None:
    rows = [row if known or place else {**row, "error_std": math.nan} for place, row in enumerate(ROWS)]
    figure = diagram(rows)
    assert bool(lines_with(figure, markersize=13)) is known
    assert ("Pareto" in words(figure)) is known
    assert ("no front: standard errors not known" in words(figure)) is not known


def test_higher_is_better_turns_the_front_and_keeps_a_linear_axis() -> None:
    figure = diagram(ROWS, group="class", better={"error": "higher"})
    assert figure.axes[0].get_yscale() == "linear"
    rings = [line.get_xydata().tolist() for line in lines_with(figure, markersize=13)]
    assert rings == [[[1, 5], [3, 6]], [[1, 9], [2, 9.5]]]


@pytest.mark.parametrize(
    "rows", [[], ROWS[:1], [{"method": "a", "error": -1.0, "ms": 2.0, "error_sem": math.nan}]]
)
def test_odd_comparisons_are_drawn(rows: list[dict], tmp_path: Path) -> None:
    drawn(diagram(rows), tmp_path)


@pytest.mark.parametrize(
    ("panels", "times", "error"),
    [
        *((1, times, error) for times in [(1.19,), (1.19, 1.19), (1e-5, 1e6)] for error in [3.0, 0.0, -5.0]),
        (1, (1.19,), 1e-300),
        (2, (1.19, 1.19), -5.0),
        (4, (1e-5, 1e6), 0.0),
    ],
)
def test_a_result_alone_stands_in_the_middle_of_its_panels(
    panels: int, times: tuple[float, ...], error: float, tmp_path: Path
) -> None:
    """Return the rows of a sweep in which only the seed varies."""
    keys = [f"error {panel}" for panel in range(panels)]
    rows = [{"method": "a", "class": "car", "ms": time} | dict.fromkeys(keys, error) for time in times]
    figure = error_against_run_time(
        rows,
        dict(zip(keys, keys, strict=True)),
        {},
        title="",
        synthetic=False,
        machine="m",
        time="ms",
        group="class",
    )
    drawn(figure, tmp_path)
    for axes in figure.axes[:panels]:
        places = axes.transAxes.inverted().transform(
            axes.transData.transform([(time, error) for time in times])
        )
        assert (places > 0.04).all() and (places < 0.96).all(), places


def test_intervals_are_drawn_in_the_order_of_predictions_and_counted(tmp_path: Path) -> None:
    """Ends that are infinite reach the edges of the panel; an empty interval (NaN) contains nothing."""
    numbers = [
        Intervals(
            "$y_0$ < 3",
            0.9,
            low=np.array([0.0, -math.inf, math.nan, 5.0]),
            high=np.array([2.0, math.inf, math.nan, 6.0]),
            point=np.array([4.0, 1.0, 3.0, 2.0]),
            truth=np.array([1.0, 100.0, 3.0, 7.0]),
        ),
        Intervals("constant", 0.55, *(np.full(4, 2.0) for _ in range(4))),
    ]
    figure = draw_intervals(numbers, title="a table", synthetic=True)
    assert "2 of 4 true values are inside (50 %; stated: 90 %)" in words(figure)
    assert "4 of 4 true values are inside (100 %; stated: 55 %)" in words(figure)
    assert "a table (synthetic data)" in words(figure) and "$y_0$ < 3" in words(figure)
    first = figure.axes[0]
    lines = {line.get_label(): line.get_xydata() for line in first.get_lines()}
    assert lines["prediction"][:, 1].tolist() == [1.0, 2.0, 3.0, 4.0]
    assert lines["true value, inside"].tolist() == [[0.0, 100.0], [3.0, 1.0]]
    assert lines["true value, outside"].tolist() == [[1.0, 7.0], [2.0, 3.0]]
    assert first.get_ylim()[1] > 100
    drawn(figure, tmp_path)


def test_many_methods_and_classes_stay_apart(tmp_path: Path) -> None:
    rows = [
        {"method": f"method {m}", "class": f"class {c}", "error": 1.0 + m + c, "ms": 1.0 + m}
        for m in range(9)
        for c in range(12)
    ]
    figure = diagram(rows, group="class")
    looks = {
        (point.get_color(), point.get_markerfacecolor(), point.get_marker())
        for point in (container.lines[0] for container in figure.axes[0].containers)
    }
    assert len(looks) == 9 * 12
    drawn(figure, tmp_path)


def test_tables_import_no_torch_costs_no_matplotlib_and_pictures_no_pyplot() -> None:
    code = (
        "import sys, framework.reports.table; assert not {'torch', 'matplotlib'} & set(sys.modules)\n"
        "import framework.evaluation.cost; assert 'matplotlib' not in sys.modules\n"
        "from framework.reports import tradeoff_picture, viewing_circles, training_curve, class_picture\n"
        "from framework.reports import landscape_picture; assert 'matplotlib.pyplot' not in sys.modules"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("pictures, suffix", [("svg", "svg"), (True, "png")])
def test_a_sweep_is_drawn_as_its_jobs_are_and_names_data_machine_and_what_was_varied(
    pictures: str | bool, suffix: str, tmp_path: Path
) -> None:
    (tmp_path / "config.yaml").write_text(f"pictures: {pictures}\n".lower())
    rows = [
        {"method": method, "data": data, "mlp.widths": widths, "seed": seed, "nll": 0.5 + 0.1 * seed}
        | {"milliseconds_per_sample": 1.0, "device": "cpu (X)", "threads": threads, "synthetic": True}
        | {"columns": {"nll": "NLL (nats)"}, "better": {"nll": "lower"}, "folder": str(tmp_path)}
        for method, widths, threads in (("a", "[8]", 1), ("a", "[16]", 2), ("b", None, 2))
        for data in ("faces", "cells")
        for seed in (0, 1)
    ]
    by = ["method", "data", "mlp.widths"]
    for data in (("faces",), ("faces", "cells")):
        some = [row for row in rows if row["data"] in data]
        compared = Comparison(some, aggregate(some, by), by, [], {"nll": "NLL (nats)"}, {"nll": "lower"})
        figure = comparison_figure(compared)
        assert figure is not None
        path = comparison._save(figure, compared, tmp_path)
        assert path.name == f"comparison.{suffix}"
        if suffix == "svg":
            said = " ".join(re.findall("<!-- (.*?) -->", path.read_text(encoding="utf-8"), re.S))
            title = "faces: NLL (nats)" if len(data) == 1 else "2 data sets: NLL (nats)"
            assert f"{title} against run time (synthetic data)" in said
            assert "on cpu (X), 1 thread; cpu (X), 2 threads" in said
            assert "a, widths=[8]" in said and "a, widths=[16]" in said and "None" not in said
            assert ("cells" in said) is (len(data) == 2)
