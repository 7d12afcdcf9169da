"""Tests of the Bernoulli image head beyond its contract: torch's Bernoulli, calibration and masks."""

import pytest
import torch
from torch.distributions import Bernoulli, Independent

from framework.distributions.density import Mixture
from framework.distributions.protocol import images, median, pick
from framework.distributions.tempering import temper
from framework.errors import UserError
from framework.geometry.srgb import linear_from_srgb
from framework.target import Target
from plugins.density_head.bernoulli_image.density import BernoulliImage
from plugins.density_head.bernoulli_image.head import SMALLEST, BernoulliImageHead

TARGET = Target("image", ("subject",), size=(4, 5))


def density(*batch: int, numbers: int = 1) -> BernoulliImage:
    torch.manual_seed(0)
    return BernoulliImage(3 * torch.randn(*batch, 4, 5, numbers).double())


def test_it_is_torchs_bernoulli_of_every_number() -> None:
    ours = density(2, 3, numbers=2)
    theirs = Independent(Bernoulli(logits=ours.logits), 3)
    value = torch.randint(2, (7, 2, 3, 4, 5, 2)).double()
    torch.testing.assert_close(ours.log_prob(value), theirs.log_prob(value))
    torch.testing.assert_close(ours.entropy(), theirs.entropy())
    torch.testing.assert_close(ours.mean, theirs.mean)
    torch.testing.assert_close(ours.variance, theirs.variance)
    assert torch.equal(ours.mode, theirs.mode) and torch.equal(median(ours, 1), theirs.mode)
    samples = ours.sample(torch.Size((20_000,)))
    assert set(samples.unique().tolist()) == {0.0, 1.0}
    torch.testing.assert_close(samples.mean(0), ours.mean, atol=0.02, rtol=0)
    # a quarter of a pixel counts for a quarter
    half = ours.log_prob(torch.full((4, 5, 2), 0.25).double())
    parts = [ours.log_prob(torch.full((4, 5, 2), number).double()) for number in (1.0, 0.0)]
    torch.testing.assert_close(half, 0.25 * parts[0] + 0.75 * parts[1])


@pytest.mark.parametrize("size", [0.0, 1e-12, 1.0, 40.0, 800.0, 1e30])
def test_entropy_and_log_prob_are_finite_and_right_however_sure(size: float) -> None:
    for sign in (-1.0, 1.0):
        pixel = BernoulliImage(torch.full((1, 1, 1), sign * size).double())
        both = torch.stack([pixel.log_prob(torch.full((1, 1, 1), number).double()) for number in (0.0, 1.0)])
        assert both.isfinite().all() and both.exp().sum() == pytest.approx(1.0, abs=1e-15)
        assert float(pixel.entropy()) == pytest.approx(float(-(both.exp() * both).sum()), abs=1e-12)


def test_members_tempering_and_picking_keep_the_shape_of_an_image() -> None:
    members = density(2, 3)
    whole = Mixture(torch.zeros(2, 3).double(), members)
    value = torch.randint(2, (2, 4, 5, 1)).double()
    parts = torch.stack([BernoulliImage(members.logits[:, k]).log_prob(value) for k in range(3)])
    torch.testing.assert_close(whole.log_prob(value), parts.logsumexp(0) - torch.tensor(3.0).double().log())
    chosen = pick(members, torch.tensor([2, 0]))
    assert torch.equal(chosen.logits, torch.stack([members.logits[0, 2], members.logits[1, 0]]))
    hot = temper(members, torch.tensor(2.0).double())
    image, inverted = value.unsqueeze(1), 1 - value.unsqueeze(1)
    odds = hot.log_prob(image) - hot.log_prob(inverted)
    torch.testing.assert_close(odds, (members.log_prob(image) - members.log_prob(inverted)) / 2)


def test_a_mask_is_what_is_rather_there_and_the_colour_the_light_of_its_share() -> None:
    silhouettes = density(2)
    channel_images = images(silhouettes, {"color", "mask"})
    assert channel_images["mask"].dtype == torch.bool and torch.equal(
        channel_images["mask"], silhouettes.mean[..., 0] >= 0.5
    )
    torch.testing.assert_close(channel_images["color"], linear_from_srgb(silhouettes.mean))
    for density_, channels in ((silhouettes, {"depth"}), (density(2, numbers=3), {"mask"})):
        with pytest.raises(UserError, match="provides no"):
            images(density_, channels)


def test_the_loss_is_the_cross_entropy_a_number_and_calibration_finds_the_likeliest_factor() -> None:
    generator = torch.Generator().manual_seed(0)
    truth = 2 * torch.randn(64, 1, 4, 5, generator=generator)
    target = truth.sigmoid().bernoulli(generator=generator).movedim(1, -1)
    raw = (-3 * truth).sigmoid()  # white where the truth is 0; log-odds three times too large
    head = BernoulliImageHead(TARGET)
    cut = raw.clamp(SMALLEST, 1 - SMALLEST).double()
    wanted = torch.nn.functional.binary_cross_entropy(
        1 - cut, target.movedim(-1, 1).double(), reduction="none"
    ).mean((1, 2, 3))
    torch.testing.assert_close(head.loss(raw, target), wanted.float())
    losses = {}
    head.calibrate(raw, target)
    fitted = float(head.factor)
    for factor in (0.95 * fitted, fitted, 1.05 * fitted):
        head.factor.fill_(factor)
        losses[factor] = -float(head(raw).log_prob(target).double().mean())
    assert min(losses, key=losses.__getitem__) == fitted and fitted == pytest.approx(0.4, abs=0.1)
    torch.testing.assert_close(head.loss(raw, target), wanted.float())  # independent of the calibration
    with pytest.raises(ValueError, match="this split is empty"):
        head.calibrate(raw[:0], target[:0])
