"""Agreement between the runs that `reproduction.contradictions` compares and the runs that it, or the tables, start."""

import math

import numpy as np
import pytest

from reproduction import thesis_tables
from reproduction.contradictions import NOISE_DEG, PARTS, Part, add_label_noise


@pytest.mark.parametrize("part", PARTS, ids=lambda part: part.sweep)
def test_rows_are_runs_that_are_made_and_no_run_is_left_out(part: Part) -> None:
    sweeps = {name: words for table in thesis_tables.TABLES.values() for name, words in table.sweeps.items()}
    assert part.sweep not in sweeps
    sweeps[part.sweep] = part.words
    for label, (sweep, *words) in part.rows.items():
        assert any(set(words) <= set(overrides) for overrides in thesis_tables.expand_sweep(sweeps[sweep])), (
            label
        )
    own = [set(words) for sweep, *words in part.rows.values() if sweep == part.sweep]
    assert all(
        sum(words <= set(overrides) for words in own) == 1
        for overrides in thesis_tables.expand_sweep(part.words)
    )


def test_errors_of_labels_have_their_spread() -> None:
    random = np.random.default_rng(0)
    errors = np.degrees([add_label_noise((1.0, -1.0, 0.0), random) for _ in range(4000)]) - np.degrees(
        [1.0, -1.0, 0.0]
    )
    assert errors.mean(0) == pytest.approx(0, abs=5 * NOISE_DEG / math.sqrt(4000))
    assert errors.std(0) == pytest.approx(NOISE_DEG, rel=5 / math.sqrt(2 * 4000))
