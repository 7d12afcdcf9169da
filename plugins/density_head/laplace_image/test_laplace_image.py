"""Tests of the Laplace image head beyond its contract: torch's Laplace, loss, calibration and image."""

import pytest
import torch
from torch.distributions import Independent, Laplace

from framework.distributions import density as density_module
from framework.distributions.density import Mixture
from framework.distributions.protocol import images, marginal_cdfs, median, pick
from framework.distributions.tempering import temper
from framework.errors import ConfigError, UserError
from framework.geometry.srgb import linear_from_srgb, srgb_from_linear
from framework.target import Target
from plugins.density_head.laplace_image.density import LaplaceImage
from plugins.density_head.laplace_image.head import LaplaceImageHead

TARGET = Target("image", ("red", "green", "blue"), size=(4, 5))


def density(*batch: int) -> LaplaceImage:
    torch.manual_seed(0)
    return LaplaceImage(torch.rand(*batch, 4, 5, 3).double(), torch.rand(*batch, 4, 5, 1).double() + 0.1)


def test_it_is_torchs_laplace_of_every_number() -> None:
    ours = density(2, 3)
    theirs = Independent(Laplace(ours.location, ours.scale), 3)
    value = torch.randn(7, 2, 3, 4, 5, 3).double()
    torch.testing.assert_close(ours.log_prob(value), theirs.log_prob(value))
    torch.testing.assert_close(ours.entropy(), theirs.entropy())
    torch.testing.assert_close(ours.variance, theirs.variance)
    samples = ours.sample(torch.Size((20_000,)))
    torch.testing.assert_close(samples.std(0), theirs.stddev, rtol=0.06, atol=0)
    torch.testing.assert_close((samples - ours.location).abs().mean(0) / ours.scale, torch.ones(2, 3, 4, 5, 3).double(),
                               rtol=0.06, atol=0)  # fmt: skip
    torch.testing.assert_close(median(ours, 1), ours.location)


def test_members_tempering_and_picking_keep_the_shape_of_an_image() -> None:
    members = density(2, 3)
    whole = Mixture(torch.zeros(2, 3).double(), members)
    value = torch.rand(2, 4, 5, 3).double()
    parts = torch.stack(
        [LaplaceImage(members.location[:, k], members.scale[:, k]).log_prob(value) for k in range(3)]
    )
    torch.testing.assert_close(whole.log_prob(value), parts.logsumexp(0) - torch.tensor(3.0).double().log())
    chosen = pick(members, torch.tensor([2, 0]))
    assert torch.equal(chosen.mode, torch.stack([members.location[0, 2], members.location[1, 0]]))
    assert whole.sample().shape == (2, 4, 5, 3)
    hot = temper(members, torch.tensor(2.0).double())
    change = hot.log_prob(value.unsqueeze(1)) - members.log_prob(value.unsqueeze(1)) / 2
    other = hot.log_prob(1 - value.unsqueeze(1)) - members.log_prob(1 - value.unsqueeze(1)) / 2
    torch.testing.assert_close(change, other)  # a power of it, normalised


def test_the_picture_is_the_light_of_its_numbers_and_that_of_members_their_mean() -> None:
    members = density(2, 3)
    colors = images(members, {"color"})["color"]
    torch.testing.assert_close(srgb_from_linear(colors), members.location)
    whole = images(Mixture(torch.zeros(2, 3).double(), members), {"color"})["color"]
    torch.testing.assert_close(whole, colors.mean(1))
    with pytest.raises(UserError, match="provides no depth"):
        images(members, {"depth"})


@pytest.mark.parametrize("white", [1.0, 1 - 2**-24])
def test_the_loss_is_the_distance_a_number_and_the_foreground_counts_more(white: float) -> None:
    """Check the loss, also where white has lost a bit in the conversion to linear RGB: 0.99999994."""
    raw = torch.rand(2, 3, 4, 5)
    target = torch.full((2, 4, 5, 3), white)
    target[:, :2] = 0.25
    distance = (raw.movedim(1, -1) - target).abs()
    head = LaplaceImageHead(TARGET)
    torch.testing.assert_close(head.loss(raw, target), distance.mean((1, 2, 3)) + torch.tensor(2.0).log())
    weighted = LaplaceImageHead(TARGET, foreground=5.0).loss(raw, target)
    wanted = (5 * distance[:, :2].mean((1, 2, 3)) + distance[:, 2:].mean((1, 2, 3))) / 6
    torch.testing.assert_close(weighted, wanted + torch.tensor(2.0).log())


@pytest.mark.parametrize("scale", ["fixed", "pixel", "number"])
def test_calibration_takes_the_most_likely_factor_and_leaves_the_loss(scale: str) -> None:
    head = LaplaceImageHead(TARGET, scale=scale)  # type: ignore[arg-type]
    raw = torch.randn(6, *head.raw_shape)
    target = torch.rand(6, 4, 5, 3)
    before = head.loss(raw, target)
    head.calibrate(raw, target)
    best = head(raw).log_prob(target).sum()
    assert torch.equal(head.loss(raw, target), before)
    for other in (0.98, 1.02):
        head.factor *= other
        assert head(raw).log_prob(target).sum() < best
        head.factor /= other
    with pytest.raises(ValueError, match="this split is empty"):
        head.calibrate(raw[:0], target[:0])


def test_balanced_locations_are_learned_as_by_the_distance_and_scales_as_by_likelihood() -> None:
    torch.manual_seed(0)
    target = torch.rand(2, 4, 5, 3).double()
    gradients = []
    for balance in (0.0, 1.0):
        raw = torch.randn(2, 4, 4, 5, generator=torch.Generator().manual_seed(1)).double().requires_grad_()
        loss = LaplaceImageHead(TARGET, scale="pixel", balance=balance).loss(raw, target)
        loss.sum().backward()
        gradients.append((loss.detach(), raw.grad, raw.detach()))
    (plain, by_likelihood, raw), (loss, balanced, _) = gradients
    torch.testing.assert_close(loss, plain)
    torch.testing.assert_close(balanced[:, :3], (raw[:, :3] - target.movedim(-1, 1)).sign() / 60)
    torch.testing.assert_close(balanced[:, 3], by_likelihood[:, 3] * raw[:, 3].exp())


@pytest.mark.parametrize("mass", [0.5, 0.9])
def test_intervals_are_fitted_to_what_is_not_background(mass: float) -> None:
    """Check a background with errors of a thousandth of its scale, which makes the likeliest factor too small."""
    torch.manual_seed(0)
    target = torch.full((6, 4, 5, 3), 1 - 2**-24)
    target[:, 0] = torch.rand(6, 5, 3) / 2
    raw = torch.cat([target.movedim(-1, 1) + 1e-3 * torch.randn(6, 3, 4, 5), torch.zeros(6, 1, 4, 5)], 1)
    raw[:, :3, 0] += torch.randn(6, 3, 5) * 3

    def covered(head: LaplaceImageHead) -> float:
        head.calibrate(raw, target)
        quantiles = marginal_cdfs(head(raw), target)[:, 0]
        return ((2 * quantiles - 1).abs() <= mass + 1e-6).double().mean().item()

    assert covered(LaplaceImageHead(TARGET, scale="pixel", cover=mass)) == pytest.approx(mass, abs=0.02)
    assert covered(LaplaceImageHead(TARGET, scale="pixel")) < mass - 0.15
    with pytest.raises(ValueError, match="pixels that are not white"):
        LaplaceImageHead(TARGET, cover=mass).calibrate(torch.zeros(2, 3, 4, 5), torch.ones(2, 4, 5, 3))


def test_other_targets_are_refused() -> None:
    with pytest.raises(ConfigError, match="describes targets of kind 'image'"):
        LaplaceImageHead(Target("real", ("x",)))


def test_light_and_numbers_are_inverse() -> None:
    numbers = torch.linspace(0, 1, 1001, dtype=torch.float64)
    torch.testing.assert_close(srgb_from_linear(linear_from_srgb(numbers)), numbers, rtol=0, atol=1e-6)


def test_the_entropy_of_members_of_large_images_is_drawn_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Check that no more numbers than the bound are held, and the entropy of distant members.

    It is the mean entropy of the members plus that of the choice among them.
    """
    members = LaplaceImage(
        torch.tensor([0.0, 50.0]).double().reshape(1, 2, 1, 1, 1).expand(1, 2, 20, 20, 3),
        torch.tensor(0.1).double(),
    )
    whole = Mixture(torch.zeros(1, 2).double(), members)
    largest: list[int] = []
    sample = LaplaceImage.sample

    def counted(self: LaplaceImage, shape: torch.Size) -> torch.Tensor:
        largest.append(shape.numel() * self.location.numel())
        return sample(self, shape)

    monkeypatch.setattr(LaplaceImage, "sample", counted)
    monkeypatch.setattr(density_module, "LARGEST", 10_000)
    with torch.no_grad():
        entropy = whole.entropy()
    assert len(largest) > 100
    assert max(largest) <= 10_000
    torch.testing.assert_close(entropy, members.entropy().mean(1) + torch.tensor(2.0).double().log())
