"""Flights from files to windows, states from windows, and what heads say of them."""

import os
from dataclasses import fields
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError, NonFiniteAnswer
from framework.model import Model
from framework.target import Target
from plugins.data.table_tennis.ballistic import BallisticHead
from plugins.data.table_tennis.estimation import cauchy, estimated, seen_of
from plugins.data.table_tennis.flight_error import crossing, from_start, landings, last_seen
from plugins.data.table_tennis.flying import flown
from plugins.data.table_tennis.identification import FITTED, HIGH, LOW
from plugins.data.table_tennis.parabolas_compiled import parabolas
from plugins.data.table_tennis.physics import Constants
from plugins.data.table_tennis.recordings import Flight
from plugins.data.table_tennis.rows import FLIGHT, table, thrown, write_csv
from plugins.data.table_tennis.test_physics import START
from plugins.data.table_tennis.windows import PARTS, Grid, believed, prefix, windows

SIGMA = 0.003


def prepared(**config: Any) -> Any:
    data = build("data", resolve("data", {"name": "table_tennis", **config}))
    data.prepare()
    return data


def windows_of(count: int, outliers: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Frames read (count, 20, 5), the future (count, 35, 3) without noise, and the states at the first frame."""
    random = np.random.default_rng(0)
    states = torch.from_numpy(
        START + random.normal(size=(count, 9)) * [0.1, 0.05, 0.05, 0.3, 0.3, 0.2, 40, 40, 40]
    )
    times = 0.016 * torch.arange(55, dtype=torch.float64).expand(count, -1)
    places = flown(states, times, Constants())[..., :3]
    seen = places[:, :20] + SIGMA * torch.from_numpy(random.normal(size=(count, 20, 3)))
    there = torch.from_numpy(random.random((count, 20, 1)) > 0.1)
    if outliers:
        seen = seen + (torch.from_numpy(random.random((count, 20, 1))) < 0.1) * 0.4
    frames = torch.cat([times[:, :20, None] - times[:, 19:20, None], seen, torch.ones(count, 20, 1)], -1)
    return frames * there, places[:, 20:], states


@pytest.mark.parametrize(
    "line, rows, words",
    [
        ("0.050000,0.1,0.2,0.3", slice(0, 3), "line 5: the time 0.05 s comes after 0.08 s"),
        ("0.096000,0.1,0.2,inf", slice(0, 3), "line 8, column 'z'"),
        ("0.096000,0.1,0.2,1e9", slice(0, 3), "line 8: t, x, y, z"),
        ("0.096000,0.1,0.2", slice(0, 3), "line 8: 3 cells"),
    ],
)
def test_a_bad_frame_is_told_by_file_and_line(tmp_path: Path, line: str, rows: slice, words: str) -> None:
    file = write_csv(tmp_path / "bad.csv", table(0, 6))
    lines = file.read_text().splitlines()
    at = 4 if "0.05" in line else len(lines)
    lines.insert(at, line)
    if at == 4:
        lines[3] = lines[3].replace("0.032000", "0.080000")
    file.write_text("\n".join(lines))
    with pytest.raises(DataError, match=words.replace("(", r"\(")) as told:
        prepared(root=str(tmp_path))
    assert "bad.csv" in str(told.value)


def test_another_frame_rate_is_told_with_the_remedy(tmp_path: Path) -> None:
    rows = table(0)
    rows[:, 0] *= 4
    write_csv(tmp_path / "slow.csv", rows)
    with pytest.raises(DataError, match=r"a frame every 64 ms.*Set data.step=0.064"):
        prepared(root=str(tmp_path))
    rows[:, 0] *= 1e5
    write_csv(tmp_path / "slow.csv", rows)
    with pytest.raises(
        DataError, match=r"at most 1 s apart, in seconds or in data\.times_in\. Mend the times"
    ):
        prepared(root=str(tmp_path))


@pytest.mark.parametrize("unit, seconds", [("milliseconds", 1e-3), ("microseconds", 1e-6), ("seconds", 1.0)])
@pytest.mark.parametrize("said", ["seconds", "milliseconds", "microseconds"])
def test_times_in_another_unit_are_read_as_that_is_said(
    tmp_path: Path, unit: str, seconds: float, said: str
) -> None:
    """And where another unit is said, the message names the right one, which the schema then takes."""
    tables = [table(number) for number in range(4)]
    for number, rows in enumerate(tables):
        write_csv(tmp_path / f"{number}.csv", np.column_stack([rows[:, 0] / seconds, rows[:, 1:]]))
    if said == unit:
        data = prepared(root=str(tmp_path), times_in=said, future=5)
        first = data.read([tmp_path / "0.csv"])[0]["input"].view(20, 5)
        np.testing.assert_allclose(first[-1, 1:4], tables[0][-1, 1:], atol=1e-5)
        np.testing.assert_allclose(first[-2, 0], -0.016, atol=1e-6)
    else:
        with pytest.raises(DataError, match=rf"0\.csv has a frame every .* Set data\.times_in={unit}\."):
            prepared(root=str(tmp_path), times_in=said, future=5)


def test_millimetres_and_other_columns_are_said(tmp_path: Path) -> None:
    for number in range(4):
        file = write_csv(tmp_path / f"{number}.csv", table(number))
        head, *lines = file.read_text().splitlines()
        file.write_text("\n".join([f"{head},spin,note", *(f"{line},3,x" for line in lines)]))
    assert prepared(root=str(tmp_path), future=5).remarks[0] == "left out: the columns spin, note"
    rows = table(0)
    rows[:, 1:] *= 1000
    write_csv(tmp_path / "0.csv", rows)
    with pytest.raises(
        DataError, match=r"0\.csv line 2: .* divide all of them by 1000 if they are millimetres"
    ):
        prepared(root=str(tmp_path), future=5)


def test_a_missing_frame_is_masked_and_a_gap_in_the_future_leaves_the_window_out() -> None:
    rows = table(0, 30)
    grid = Grid(observed=6, future=4, least=4, stride=1)
    whole = Flight("whole", rows[:, 0], rows[:, 1:])
    found = windows(whole, grid)
    assert [window.frame for window in found] == list(range(3, 26))
    np.testing.assert_allclose(found[2].target.reshape(4, 3), rows[6:10, 1:], atol=1e-9)
    holed = np.delete(rows, 10, 0)
    flight = Flight("holed", holed[:, 0], holed[:, 1:])
    read = prefix(flight, 11, grid)
    assert read is not None
    read = read.reshape(6, 5)
    assert read[:, 4].tolist() == [1, 1, 1, 0, 1, 1] and not read[3].any()
    np.testing.assert_allclose(read[0, :4], [-0.08, *rows[7, 1:]])
    # one missing frame is interpolated on the parabola, two are not
    one = next(window for window in windows(flight, grid) if window.frame == 8)
    np.testing.assert_allclose(one.target.reshape(4, 3)[1], rows[10, 1:], atol=1e-4)
    wide = np.delete(rows, [10, 11], 0)
    frames = [window.frame for window in windows(Flight("wide", wide[:, 0], wide[:, 1:]), grid)]
    assert not set(frames) & {6, 7, 8, 9} and {3, 4, 5, 10} <= set(frames)


def test_an_outlier_is_read_and_is_no_truth() -> None:
    rows = table(0, 30)
    rows[12, 1:] += [0.3, 0, 0.2]
    flight = Flight("strange", rows[:, 0], rows[:, 1:])
    assert np.flatnonzero(~believed(flight, 0.12)).tolist() == [12]
    grid = Grid(observed=6, future=4, least=4, stride=1)
    window = next(window for window in windows(flight, grid) if window.frame == 10)
    np.testing.assert_allclose(window.target.reshape(4, 3)[1], table(0, 30)[12, 1:], atol=1e-4)
    read = prefix(flight, 12, grid)
    assert read is not None
    np.testing.assert_allclose(read.reshape(6, 5)[-1, 1:4], rows[12, 1:])


@pytest.mark.skipif("REAL_DATA_ROOT" not in os.environ, reason="REAL_DATA_ROOT is not set")
def test_the_laboratorys_flights_are_82_and_none_is_in_two_splits() -> None:
    data = prepared(root=f"{os.environ['REAL_DATA_ROOT']}/trajectories", observed=12, future=22)
    words = data.fingerprint()
    assert words["repeated"] == "40"
    flights = [set(split.fields["flight"].tolist()) for split in data.splits()]
    assert sum(map(len, flights)) + int(words["too short"]) == 82
    assert not (flights[0] & flights[1] or flights[0] & flights[2] or flights[1] & flights[2])


def test_noise_and_constants_and_stiff_contact_change_what_is_simulated() -> None:
    small = {"flights": 5, "observed": 6, "future": 4, "least": 4, "stride": 20}
    digests = {prepared(**small, **more).fingerprint()["sha256"] for more in (
        {}, {"noise": 0.01}, {"drag": 0.1}, {"contact": "spring"}, {"outliers": 0.2}, {"dropped": 0.3},
    )}  # fmt: skip
    assert len(digests) == 6


def test_states_are_those_of_scipys_robust_least_squares() -> None:
    frames, _, _ = windows_of(4)
    seen = seen_of(frames, 0.016)
    found = estimated(seen, Constants(), SIGMA, most=200)
    for row in range(4):
        there = seen.there[row]

        def residuals(state: np.ndarray, row: int = row, there: torch.Tensor = there) -> np.ndarray:
            places = flown(torch.from_numpy(state)[None], seen.times[row : row + 1], Constants())[0, :, :3]
            apart = ((places - seen.places[row])[there] / SIGMA).flatten()
            return np.concatenate([cauchy(apart)[0].numpy(), state / ([10] * 6 + [60] * 3)])

        best = least_squares(
            residuals, found.state[row].numpy(), x_scale=[0.01] * 3 + [0.1] * 3 + [10] * 3, xtol=1e-12
        )
        assert found.cost[row] <= best.cost * (1 + 1e-5)


def test_outliers_do_not_move_the_state() -> None:
    clean, future, _ = windows_of(40)
    dirty, _, _ = windows_of(40, outliers=True)
    errors = []
    for frames in (clean, dirty):
        seen = seen_of(frames, 0.016)
        found = estimated(seen, Constants(), SIGMA)
        times = torch.cat([seen.times, 0.016 * torch.arange(1, 36).double().expand(40, -1)], 1)
        places = flown(found.state, times, Constants())[:, 20:, :3]
        errors.append((places - future).norm(dim=-1).mean(0).median())
    assert errors[1] < 1.5 * errors[0] and errors[0] < 0.05


@pytest.mark.parametrize("density", ["linearised", "sampled"])
def test_the_physics_covers_what_it_simulated(density: str) -> None:
    frames, future, _ = windows_of(60)
    target = Target("real", Grid(future=35).names)
    config = {"name": "ballistic", "density": density, "identify": False, "samples": 60}
    head = build("density_head", resolve("density_head", config), target=target).eval()
    torch.manual_seed(0)
    found = head(frames.flatten(1)).sample((199,))
    noisy = future.flatten(1) + SIGMA * torch.randn(future.flatten(1).shape)
    rank = (found < noisy).sum(0)
    assert ((rank >= 10) & (rank < 190)).double().mean().item() == pytest.approx(0.9, abs=0.05)


def test_heads_refuse_what_is_no_flight() -> None:
    target = Target("real", ("x", "y"))
    for name in ("ballistic", "lstm"):
        with pytest.raises(ConfigError, match="predicts x, y and z at one time after the other"):
            build("density_head", resolve("density_head", name), target=target)


def test_an_untrained_hybrid_is_about_the_encoders_mean() -> None:
    target = Target("real", ("x", "y"), (3.0, -1.0), (0.1, 20.0))
    head = build("density_head", resolve("density_head", {"name": "hybrid", "further": 1}), target=target)
    units = torch.tensor([[0.005, 1.0], [0.1, 20.0]])
    raw = torch.cat([torch.tensor([[3.2, 15.0], [2.9, -30.0]]), units.log(), torch.tensor([[0.4], [7.0]])], 1)
    torch.testing.assert_close(head(raw).mode, raw[:, :2].double())
    # the component starts with a standard deviation of 1
    torch.testing.assert_close(head(raw).sample((4000,)).std(0), units.double(), rtol=0.06, atol=0)
    value = raw[:, :2] + 0.7 * units
    torch.testing.assert_close(
        head.loss(raw, value), -head(raw).log_prob(value).to(torch.float32), check_dtype=False
    )


@pytest.mark.parametrize("component", ["gaussian", "cvae"])
def test_a_hybrid_does_not_care_for_the_targets_unit(component: str) -> None:
    found = []
    for location, scale in (((3.0, -1.0), (0.1, 20.0)), ((0.0, 0.0), (1.0, 1.0))):
        target = Target("real", ("x", "y"), location, scale)
        config = {"name": "hybrid", "further": 1, "component": {"name": component}}
        if component == "cvae":
            config["component"] |= {"component": {"name": "gaussian"}}
        torch.manual_seed(0)
        head = build("density_head", resolve("density_head", config), target=target).eval()
        # what is read of the mean is in the target's unit; here it is read as it is
        torch.nn.init.zeros_(head.network[0].weight[:, :2].detach())
        raw = torch.tensor([[3.2, 15.0, -5.0, 0.0, 0.4], [2.9, -30.0, -2.0, 3.0, 7.0]])
        torch.manual_seed(1)
        density = head(raw)
        found.append((density.log_prob(raw[:, :2].double()).detach(), density.sample((5,)).detach()))
    for one, other in zip(*found, strict=True):
        torch.testing.assert_close(one.double(), other.double(), rtol=1e-4, atol=1e-4)


def test_landing_places_against_their_formulas() -> None:
    times = torch.arange(20).double() * 0.05
    path = torch.stack([2 * times, 3 - times, 0.5 - times], -1)
    place, lands = crossing(path, 0.02)
    assert bool(lands)
    torch.testing.assert_close(place, torch.tensor([0.96, 2.52]).double())
    assert not crossing(path, -3.0)[1]
    torch.manual_seed(0)
    shift = torch.randn(400, 1, 1, 3).double() * torch.tensor([0.1, 0.2, 0.0])
    found = landings(path + shift, path[None], 0.02)
    points = (place + shift[:, 0, 0, :2]).double()
    between = (points[:, None] - points).abs().sum((0, 1)) / (400 * 399)
    crps = ((points - place).abs().mean(0) - between / 2).mean()
    torch.testing.assert_close(found, torch.tensor([1.0, crps, 1.0, 0.0]).double())


def test_a_ball_may_land_before_the_first_predicted_frame() -> None:
    """From where it was seen last, whatever the order of frames; not where it was never seen."""
    truth = torch.tensor([[[0.2, 1.0, -0.95], [0.3, 1.2, -0.8]]]).double().expand(3, -1, -1)
    frames = torch.zeros(3, 2, len(PARTS)).double()
    frames[0] = torch.tensor([[-0.032, 9.0, 9.0, 9.0, 1.0], [-0.016, 0.0, 0.8, -0.75, 1.0]])
    frames[1] = frames[0].flip(0)
    start = last_seen(frames.flatten(1), truth)
    place, lands = crossing(from_start(start, truth), -0.85)
    assert lands.tolist() == [True, True, False]
    torch.testing.assert_close(place[:2], torch.tensor([[0.1, 0.9]] * 2).double())
    draws = truth.expand(12, -1, -1, -1) + 0.01 * torch.randn(12, 3, 1, 1).double()
    assert landings(from_start(start, draws), from_start(start, truth), -0.85)[0] == 2
    assert last_seen(None, truth).isnan().all()
    assert last_seen(frames.flatten(1)[:, :7], truth).isnan().all()


@pytest.mark.parametrize("nonsense", [False, True])
def test_constants_are_found_and_of_nonsense_stay_within_their_bounds(nonsense: bool) -> None:
    frames, future, _ = windows_of(12)
    target = Target("real", Grid(future=35).names)
    wrong = {"drag": 0.1, "lift": 0.001, "restitution": 0.8, "friction": 0.2, "surface": -0.93}
    head = build("density_head", resolve("density_head", {"name": "ballistic", **wrong}), target=target)
    torch.manual_seed(0)
    if nonsense:
        frames, future = torch.randn_like(frames)[:2], torch.randn_like(future)[:2]
    head.fit(frames.flatten(1), future.flatten(1) + SIGMA * torch.randn(future.flatten(1).shape), 0)
    found = head.constants
    for name, low, high in zip(FITTED, LOW, HIGH, strict=True):
        middle = wrong["surface"] if name == "surface" else 0.0
        assert middle + low <= getattr(found, name) <= middle + high
        if not nonsense:
            near = {"lift": 1e-3, "restitution": 0.02, "surface": 0.003}.get(name, 0.01)
            assert getattr(found, name) == pytest.approx(getattr(Constants(), name), abs=near), name
    if not nonsense:
        assert head.noise.item() == pytest.approx(SIGMA, rel=0.1)


@pytest.mark.parametrize("density", ["linearised", "sampled"])
@pytest.mark.parametrize("value", [1e-30, 1e3, 1e30])
@pytest.mark.parametrize("name", ["step", *(field.name for field in fields(Constants))])
def test_physics_far_from_any_ball_give_a_density_or_a_sentence(
    name: str, value: float, density: Literal["linearised", "sampled"]
) -> None:
    step, constants = (value, Constants()) if name == "step" else (0.016, Constants(**{name: value}))
    head = BallisticHead(
        FLIGHT,
        observed=6,
        step=step,
        density=density,
        samples=3,
        steps=5,
        identify=False,
        constants=constants,
    )
    try:
        log_prob = head(thrown(2)).log_prob(torch.zeros(2, 6))
    except NonFiniteAnswer as error:
        assert "in batch row 0" in str(error)
    else:
        assert log_prob.isfinite().all()


def test_a_window_of_another_length_than_the_head_reads_is_refused() -> None:
    head = BallisticHead(FLIGHT, observed=7, constants=Constants())
    with pytest.raises(ConfigError, match="BallisticHead reads 35 numbers a sample, but gets 30"):
        Model([], head, (30,))


def test_parabolas_are_those_of_weighted_least_squares() -> None:
    """With noise, holes, outliers and a bounce; each step by NumPy's solver."""
    generator = np.random.default_rng(0)
    frames, noise, spans = 20, 0.003, np.array([20, 14, 10, 7])
    times = 0.016 * (np.arange(frames) - frames + 1) + generator.uniform(-1e-3, 1e-3, (30, frames))
    power = np.stack([np.ones_like(times), times, times**2 / 2], -1)
    places = power @ generator.normal(size=(30, 3, 3)) + noise * generator.normal(size=(30, frames, 3))
    places[10:, :8, 2] += 3 * (times[10:, :8] - times[10:, 8:9])  # another velocity before the ninth frame
    places[20:, 3::5] += 0.4
    there = generator.uniform(size=(30, frames)) > 0.1
    there[0] = False
    long, short, spread = (np.empty((30, 3, 3)) for _ in range(3))
    span = np.empty(30, np.int64)
    parabolas(times, places, there, spans, noise, long, short, spread, span)
    for flight in range(30):
        fits = []
        for last in spans:
            kept = there[flight] & (np.arange(frames) >= frames - last)
            rows, wanted = power[flight, kept], places[flight, kept]
            weight, apart = np.ones(len(rows)), np.zeros(len(rows))
            precision, found = np.eye(3), np.zeros((3, 3))
            for turn in range(8):
                precision = rows.T * weight / noise**2 @ rows + np.diag([0.01, 0.01, 1 / 16])
                found = np.linalg.solve(precision, rows.T * weight / noise**2 @ wanted)
                apart = np.linalg.norm(wanted - rows @ found, axis=1) / noise
                weight = 1 / (1 + (apart / (3 * 3.0 ** max(0, 4 - turn))) ** 2)
            fits.append((found, np.linalg.inv(precision), (apart > 5).sum() <= 2))
        best = next((number for number, fit in enumerate(fits) if fit[2]), len(spans) - 1)
        assert span[flight] == best
        np.testing.assert_allclose(long[flight], fits[best][0], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(short[flight], fits[-1][0], rtol=1e-6, atol=1e-8)
        np.testing.assert_allclose(spread[flight], fits[best][1], rtol=1e-6, atol=1e-8)
    assert len(set(span.tolist())) > 1
