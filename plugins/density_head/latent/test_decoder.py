"""Tests of the decoder of latent-variable heads against its sums written out one sample at a time."""

import torch

from plugins.density_head.latent.decoder import LARGEST_FEATURE, LatentDecoder


def test_it_is_a_network_of_both_plus_a_path_of_each() -> None:
    torch.manual_seed(0)
    decoder = LatentDecoder(latent=3, hidden=5, numbers=4).double()
    assert decoder.size == 5 + 4 + 12
    raw = torch.randn(2, 1, decoder.size, dtype=torch.float64)
    z = torch.randn(2, 7, 3, dtype=torch.float64)
    decoded = decoder(raw, z)
    for item in range(2):
        features, shared, turned = raw[item, 0, :5], raw[item, 0, 5:9], raw[item, 0, 9:].reshape(4, 3)
        for sample in range(7):
            point = z[item, sample]
            hidden = (features + decoder.from_latent.weight @ point).clamp(min=0)
            hidden = (decoder.body[1].weight @ hidden + decoder.body[1].bias).clamp(min=0)
            wanted = decoder.body[3].weight @ hidden + decoder.body[3].bias + shared
            wanted = wanted + (decoder.spread + turned) @ point
            torch.testing.assert_close(decoded[item, sample], wanted, rtol=1e-12, atol=1e-12)


def test_numbers_start_with_unit_spread_over_z() -> None:
    torch.manual_seed(1)
    decoder = LatentDecoder(latent=8, hidden=16, numbers=200)
    spread = decoder.spread.square().sum(1)  # variance of each number over z ~ N(0, I)
    assert 0.8 < spread.mean().item() < 1.2


def test_huge_features_do_not_overflow() -> None:
    torch.manual_seed(2)
    decoder = LatentDecoder(latent=2, hidden=4, numbers=3)
    z = torch.randn(5, 2)
    huge = decoder(torch.full((1, decoder.size), 3e38), z)
    assert huge.isfinite().all()
    assert torch.equal(huge, decoder(torch.full((1, decoder.size), LARGEST_FEATURE), z))
