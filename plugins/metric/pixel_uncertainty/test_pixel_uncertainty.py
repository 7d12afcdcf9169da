"""Tests of coverage and ranks of pixels, compared with SciPy and sampling, and of the figure and messages."""

import numpy as np
import pytest
import torch
from scipy.stats import laplace, rankdata, sem, spearmanr
from torch import Tensor
from torch.distributions import Distribution, HalfNormal, Independent, Laplace

from framework.configuration.schema import build, resolve
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.density import Mixture
from framework.distributions.tempering import temper
from framework.errors import ConfigError, DataError, UserError
from framework.prediction import Prediction
from framework.target import Target
from plugins.metric.pixel_uncertainty.functional import coverage, rank_correlation, ranks, transform
from plugins.metric.pixel_uncertainty.metric import LEVELS

SIZE = (24, 20)
TARGET = Target("image", ("red", "green", "blue"), size=SIZE)
LEVEL = torch.arange(1, LEVELS + 1).double() / (LEVELS + 1)


def laplaces(place: Tensor, wide: Tensor) -> Distribution:
    """Return densities of the density head `laplace_image`."""
    head = build("density_head", resolve("density_head", "laplace_image"), target=TARGET).double()
    return type(head(torch.zeros(1, *head.raw_shape).double()))(place, wide)


def images(count: int) -> tuple[Tensor, Tensor, Tensor]:
    """Return locations and scales of densities, and samples of these densities."""
    torch.manual_seed(0)
    place = 0.3 + 0.4 * torch.rand(count, *SIZE, 3).double()
    wide = torch.rand(count, *SIZE, 1).double().expand(place.shape) * 0.05 + 0.003
    return place, wide, laplaces(place, wide).sample()


def round_to_file(value: Tensor) -> Tensor:
    """Return the values rounded and clipped like in an 8-bit file."""
    return (value.clamp(0, 1) * 255).round() / 255


def compute_metric(
    density: Distribution, value: Tensor, mask: Tensor | None = None, **config
) -> dict[str, float]:
    config = {"masked": mask is not None, **config}
    metric = build("metric", resolve("metric", {"name": "pixel_uncertainty", **config}), target=TARGET)
    batch = {"target": value, "index": torch.arange(len(value))}
    metric.update(Prediction(density, batch if mask is None else {**batch, "mask": mask}))
    return {name: number.item() for name, number in metric.compute().items()}


def test_shares_and_rank_correlation_equal_scipys_over_image_and_mask() -> None:
    place, wide, value = images(5)
    value[0, :9] = value[0, 0, 0]  # ties
    mask = torch.rand(5, *SIZE) < 0.3
    mask[4] = False  # an image with an empty mask does not count inside the mask
    actual = compute_metric(laplaces(place, wide), value, mask, steps=0)
    place, wide = place.numpy(), wide.numpy()
    place_in = laplace.cdf(value.numpy(), place, wide)
    error, scale = np.abs(value.numpy() - place).mean(-1), np.sqrt(2 * (wide**2).mean(-1))
    for name, region in {"": np.ones_like(mask.numpy()), "_masked": mask.numpy()}.items():
        some = range(5 if name == "" else 4)
        shares = np.array(
            [
                [(np.abs(2 * place_in[k][region[k]] - 1) <= level).mean() for level in LEVEL.tolist()]
                for k in some
            ]
        )
        rank = [spearmanr(error[k][region[k]], scale[k][region[k]]).statistic for k in some]
        assert actual[f"pixel_coverage_90{name}"] == pytest.approx(shares[:, 17].mean(), abs=1e-12)
        assert actual[f"pixel_coverage_90{name}_sem"] == pytest.approx(sem(shares[:, 17]), rel=1e-9)
        assert actual[f"pixel_coverage_error{name}"] == pytest.approx(
            np.abs(shares.mean(0) - LEVEL.numpy()).mean(), abs=1e-12
        )
        assert actual[f"spearman{name}"] == pytest.approx(np.mean(rank), abs=1e-12)
        assert actual[f"spearman{name}_sem"] == pytest.approx(sem(rank), rel=1e-9)
        wanted = np.mean([scale[k][region[k]].mean() for k in some])
        assert actual[f"pixel_scale{name}"] == pytest.approx(wanted, rel=1e-12)


def test_ranks_share_ties() -> None:
    for values in (torch.tensor([3.0, 1, 3, 2, 1, 1]), torch.randint(9, (500,)).double()):
        assert ranks(values).tolist() == rankdata(values).tolist()
    assert rank_correlation(torch.ones(4), torch.arange(4.0)).isnan()


@pytest.mark.parametrize("wide", [1e-4, 1e-3, 0.02, 3.0])
@pytest.mark.parametrize("structure", ["one", "mixture", "tempered", "fold"])
def test_samples_of_the_density_have_the_nominal_coverage_after_rounding(structure: str, wide: float) -> None:
    """Check samples rounded to 8 bits and clipped to [0, 1], with scales from 1/40 of a step to full saturation."""
    torch.manual_seed(1)
    place = torch.rand(2, 3, *SIZE, 3).double().round(decimals=1)  # some of them exactly 0 or 1
    parts = [
        Independent(Laplace(component, torch.full_like(component, wide)), 3) for component in place.unbind(1)
    ]
    single = laplaces(place[:, 0], torch.tensor(wide).double())
    density = {
        "one": single,
        "mixture": Mixture(torch.tensor([[0.2, -1.0, 0.5]] * 2).double(), Stacked(parts)),
        "fold": Reshaped(Reshaped(single, (2, 1)), (2,)),
    }.get(structure) or temper(single, torch.tensor(1.7).double())
    # take each value from another draw, because all values of one draw of a mixture belong to one component
    draws = density.sample(torch.Size((50,)))
    value = round_to_file(draws.gather(0, torch.randint(50, (1, *draws.shape[1:])))[0])
    actual = coverage(transform(density, value, 255), LEVEL)
    noise = (LEVEL * (1 - LEVEL) / value.numel()).sqrt()
    assert ((actual - LEVEL).abs() < 5 * noise + 1e-9).all()
    # without rounding to the grid, all true values lie in the middle of their intervals
    if structure == "one" and wide < 1e-3:
        without = coverage(transform(density, value.where(place[:, 0] == 1, place[:, 0]), 0), LEVEL)
        assert without.min() > 0.5


def test_wrong_scales_are_detected_and_white_background_hides_them() -> None:
    place, wide, value = images(4)
    actual = compute_metric(laplaces(place, wide / 2), value)
    # P(|X| ≤ q/2) of a Laplace distribution
    assert actual["pixel_coverage_90"] == pytest.approx(1 - 0.1**0.5, abs=0.01)
    assert actual["pixel_coverage_error"] > 0.1
    # two thirds of the image are white and predicted as white
    mask = torch.zeros(4, *SIZE, dtype=torch.bool)
    mask[:, :8] = True
    inside = mask[..., None]
    white = laplaces(place.where(inside, 1.0), (wide / 2).where(inside, 1e-4))
    actual = compute_metric(white, value.where(inside, 1.0), mask)
    assert actual["pixel_coverage_90"] == pytest.approx(
        0.9 * 2 / 3 + actual["pixel_coverage_90_masked"] / 3, abs=1e-6
    )
    assert actual["spearman"] > actual["spearman_masked"] + 0.1, actual


def test_the_figure_does_not_depend_on_the_order_of_images() -> None:
    place, wide, value = images(30)
    metric = build("metric", resolve("metric", {"name": "pixel_uncertainty", "masked": False}), target=TARGET)
    shown = []
    for order in (torch.arange(30), torch.randperm(30)):
        metric.reset()
        for part in order.split(7):
            metric.update(
                Prediction(laplaces(place[part], wide[part]), {"target": value[part], "index": part})
            )
        assert len(metric.panels) <= 10
        figure = metric.figure("a run", synthetic=True)
        assert "synthetic" in str(figure.get_suptitle())
        shown.append([axes.get_ylabel() for axes in figure.subfigs[0].axes if axes.get_ylabel()])
    assert shown[0] == shown[1] and len(shown[0]) == 3
    scale = wide.mean((1, 2, 3))
    assert shown[0][0] == f"least certain: image {scale.argmax()}"
    assert shown[0][2] == f"most certain: image {scale.argmin()}"
    metric.reset()
    metric.figure("nothing seen", synthetic=False)


def test_unsuitable_inputs_raise_a_clear_message() -> None:
    place, wide, value = images(2)
    with pytest.raises(ConfigError, match="describes targets of kind 'image'"):
        build("metric", resolve("metric", {"name": "pixel_uncertainty"}), target=Target("real", ("x",)))
    with pytest.raises(DataError, match="requires the batch field 'mask'"):
        compute_metric(laplaces(place, wide), value, masked=True)
    with pytest.raises(UserError, match=r"protocol\.marginal_cdfs\.register"):
        compute_metric(Independent(HalfNormal(torch.full_like(value, 5.0)), 3), value)
    place[1, 0, 0, 0] = torch.nan
    with pytest.raises(
        UserError, match="1 of 2 images' transforms and scales in this batch are NaN, the first in row 1"
    ):
        compute_metric(laplaces(place, wide), value)
