"""Contact sheet of classified samples: certain, ambiguous and failed ones, each with its most likely classes."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Patch

from framework.figures.style import BLUE, GREEN, RED
from framework.reports.sample_sheet import sample_sheet

LISTED = 3
"""Number of classes that are named below each sample."""
LONGEST = 18
"""Largest number of letters of a class name that fits."""


def choose_classified(
    probability: Float[np.ndarray, "samples classes"], label: Int[np.ndarray, "samples"], count: int = 6
) -> dict[str, list[int]]:
    """Return up to `count` samples for each row; the same arguments give the same samples, and no sample occurs twice.

    "failed": wrong, highest probability first. "ambiguous": right or wrong, smallest difference between the two most
    likely classes first. "certain": right, the surest sample of each class before a second one of any class.
    """
    if len(probability) == 0:
        return {"certain": [], "ambiguous": [], "failed": []}
    guess = probability.argmax(1)
    ordered = np.sort(probability, 1)
    sure = ordered[:, -1]
    between = sure - (ordered[:, -2] if probability.shape[1] > 1 else 0)
    free = np.ones(len(probability), bool)

    def first(order: np.ndarray) -> list[int]:
        taken = order[free[order]][:count]
        free[taken] = False
        return taken.tolist()

    failed = first(np.flatnonzero(guess != label)[np.argsort(-sure[guess != label], kind="stable")])
    right = np.flatnonzero(guess == label)
    right = right[np.argsort(-sure[right], kind="stable")]
    turn = np.array([int((guess[right[:place]] == guess[one]).sum()) for place, one in enumerate(right)], int)
    certain = first(right[np.argsort(turn, kind="stable")])
    return {
        "certain": certain,
        "ambiguous": first(np.argsort(between, kind="stable")),
        "failed": failed,
    }


def classified(
    images: Sequence[np.ndarray],
    probability: Float[np.ndarray, "samples classes"],
    label: Int[np.ndarray, "samples"],
    names: Sequence[str],
    *,
    rows: Mapping[str, int],
    title: str,
    synthetic: bool,
) -> Figure:
    """Draw each sample's image, and bars for its most likely classes and the true one.

    Args:
        images: images of the samples, as `Data.preview` gives them.
        probability: predicted probabilities.
        label: true classes.
        names: names of the classes.
        rows: heading of each row, and its number of samples in their order; may be 0.
        title: title of the figure.
        synthetic: whether the data are generated.
    """
    size = {"least": 4, "width": 1.75, "heights": (1.24, 0.496), "flat": (0.186, 0.031), "margin": 1.2}
    figure, panels = sample_sheet(rows, **size, title=title, synthetic=synthetic)
    for sample, (above, below) in enumerate(panels):
        above.imshow(images[sample])
        _bars(below, probability[sample], int(label[sample]), names)
    handles = [
        Patch(color=GREEN, alpha=0.5, label="true class"),
        Patch(color=RED, alpha=0.5, label="wrong, and the likeliest"),
        Patch(color=BLUE, alpha=0.3, label="other"),
    ]
    note = "Bars and numbers: predicted probability of the likeliest classes, and of the true one"
    figure.legend(handles=handles, title=note, loc="outside lower center", ncols=3, frameon=False)
    return figure


def _bars(axes: Axes, probability: Float[np.ndarray, "classes"], label: int, names: Sequence[str]) -> None:
    """Draw the most likely classes; the true class replaces the last of them if it is not among them."""
    shown: list[int] = np.argsort(-probability, kind="stable")[:LISTED].tolist()
    if label not in shown:
        shown[-1] = label
    axes.set(xlim=(0, 1), ylim=(LISTED - 0.5, -0.5))
    for place, number in enumerate(shown):
        wrong = place == 0 and number != label
        color, alpha = (GREEN, 0.5) if number == label else (RED, 0.5) if wrong else (BLUE, 0.3)
        axes.barh(place, 1.0, height=0.9, color="0.95")
        axes.barh(place, probability[number], height=0.9, color=color, alpha=alpha)
        name = names[number] if len(names[number]) <= LONGEST else names[number][: LONGEST - 1] + "…"
        style = {"fontsize": 7, "va": "center", "parse_math": False}
        axes.text(0.02, place, name, ha="left", **style)
        axes.text(0.98, place, f"{probability[number]:.2f}", ha="right", **style)
