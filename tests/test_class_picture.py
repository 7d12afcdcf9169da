"""Selection and captions of the samples on the contact sheet of a classifier."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from matplotlib.colors import to_hex

from framework.figures.style import BLUE, GREEN, RED
from framework.reports.class_picture import choose_classified, draw_classified
from tests.test_pictures import drawn, words

NAMES = ("cone", "a_chair_with_a_very_long_name", "cup", "lamp")
PROBABILITY = np.array(
    [
        [0.9, 0.1, 0.0, 0.0],  # right
        [0.8, 0.1, 0.1, 0.0],  # right, less sure
        [0.0, 0.0, 0.7, 0.3],  # right, of another class
        [0.5, 0.49, 0.01, 0.0],  # right, ambiguous
        [0.6, 0.3, 0.06, 0.04],  # wrong, and the truth is not among the first three
        [0.05, 0.95, 0.0, 0.0],  # wrong, and sure
    ]
)
LABEL = np.array([0, 0, 2, 0, 3, 0])


def test_rows_hold_the_surest_of_each_class_the_closest_and_the_surest_mistakes():
    found = choose_classified(PROBABILITY, LABEL, 2)
    assert found == {"certain": [0, 2], "ambiguous": [3, 1], "failed": [5, 4]}


@settings(deadline=None, max_examples=60)
@given(
    logits=arrays.arrays(
        np.float64, st.tuples(st.integers(0, 9), st.integers(1, 4)), elements=st.floats(-9, 9)
    ),
    count=st.integers(1, 4),
)
def test_no_sample_stands_twice_and_each_in_its_row(logits, count):
    probability = np.exp(logits) / np.exp(logits).sum(1, keepdims=True)
    label = np.arange(len(logits)) % logits.shape[1]
    rows = choose_classified(probability, label, count)
    every = [index for row in rows.values() for index in row]
    assert len(set(every)) == len(every)
    assert all(len(row) <= count for row in rows.values())
    right = probability.argmax(1) == label
    assert right[rows["certain"]].all() and not right[rows["failed"]].any()
    assert list(rows) == ["certain", "ambiguous", "failed"]
    if len(logits):
        assert len(rows["failed"]) == min(count, (~right).sum())
        assert len(rows["certain"]) == min(count, right.sum())


def sheet(rows, order):
    images = [np.full((10, 12, 3), 20 * index, np.uint8) for index in range(len(order))]
    return draw_classified(
        images, PROBABILITY[order], LABEL[order], NAMES, rows=rows, title="Things", synthetic=True
    )


def test_each_sample_has_its_picture_and_its_likeliest_classes(tmp_path):
    figure = sheet({"certain": 2, "ambiguous": 0, "failed": 2}, [0, 2, 5, 4])
    assert len([axes for axes in figure.axes if axes.images]) == 4
    said = words(figure)
    for word in (
        "certain",
        "ambiguous",
        "failed",
        "no such sample",
        "cone",
        "a_chair_with_a_ve…",
        "0.95",
        "0.04",
    ):
        assert word in said
    assert "Things (synthetic data)" in said
    drawn(figure, tmp_path)


@pytest.mark.parametrize(
    "sample, colours", [(0, [GREEN, BLUE, BLUE]), (5, [RED, GREEN, BLUE]), (4, [RED, BLUE, GREEN])]
)
def test_the_true_class_is_always_there_and_a_wrong_guess_is_marked(sample, colours):
    (axes,) = [axes for axes in sheet({"one": 1}, [sample]).axes if axes.patches]
    bars = [bar for bar in axes.patches if bar.get_alpha() is not None]
    assert [to_hex(bar.get_facecolor()).upper() for bar in bars] == colours
    shown = [float(text.get_text()) for text in axes.texts[1::2]]
    np.testing.assert_allclose([bar.get_width() for bar in bars], shown, atol=0.005)


def test_no_samples_at_all():
    rows = choose_classified(np.zeros((0, 4)), np.zeros(0, int))
    figure = sheet({name: len(row) for name, row in rows.items()}, [])
    assert words(figure).count("no such sample") == 3
