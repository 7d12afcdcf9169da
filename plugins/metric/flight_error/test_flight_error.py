"""Tests of landing places and of scores of sampled landing places, compared with formulas."""

import torch

from framework.flights.frames import PARTS
from plugins.metric.flight_error.landing import crossing, from_start, landings, last_seen


def test_landing_places_equal_their_formulas() -> None:
    times = torch.arange(20).double() * 0.05
    path = torch.stack([2 * times, 3 - times, 0.5 - times], -1)
    place, lands = crossing(path, 0.02)
    assert bool(lands)
    torch.testing.assert_close(place, torch.tensor([0.96, 2.52]).double())
    assert not crossing(path, -3.0)[1]
    torch.manual_seed(0)
    shift = torch.randn(400, 1, 1, 3).double() * torch.tensor([0.1, 0.2, 0.0])
    actual = landings(path + shift, path[None], 0.02)
    points = (place + shift[:, 0, 0, :2]).double()
    between = (points[:, None] - points).abs().sum((0, 1)) / (400 * 399)
    crps = ((points - place).abs().mean(0) - between / 2).mean()
    torch.testing.assert_close(actual, torch.tensor([1.0, crps, 1.0, 0.0]).double())


def test_a_ball_may_land_before_the_first_predicted_frame() -> None:
    """Check the start at the last observed position for any order of frames, and NaN without an observation."""
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
