"""Tests of image metrics, compared with NumPy, kornia, torchmetrics and values computed by hand."""

import math

import kornia
import numpy as np
import pytest
import torch
from scipy import ndimage
from scipy.signal import convolve2d
from scipy.stats import sem
from torch import Tensor
from torch.distributions import Independent, Laplace
from torchmetrics.functional.image import structural_similarity_index_measure

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError, DataError, UserError
from framework.figures.chosen_images import KEPT, choose_images
from framework.geometry.srgb import bytes_from_linear, srgb_from_linear
from framework.prediction import Prediction
from framework.target import Target
from framework.testing.balls import Ball, ball
from framework.testing.metrics import simplest_density
from plugins.metric.images import functional

PLACE = Target("real", ("across", "down"))
NAMES = ("psnr", "ssim", "ms_ssim", "silhouette_iou", "depth_error")


def build_metric(name: str, **config):
    return build("metric", resolve("metric", {"name": name, **config}), target=PLACE)


def image_density(color: Tensor) -> Independent:
    """Return a density over images with this mean."""
    return Independent(Laplace(color, torch.ones_like(color), validate_args=False), 3, validate_args=False)


def colors(predicted: Tensor, true: Tensor, mask: Tensor | None = None, first: int = 0) -> Prediction:
    batch = {"index": torch.arange(first, first + len(true)), "color": true}
    return Prediction(image_density(predicted), batch if mask is None else {**batch, "mask": mask})


def random_images(*shape: int, dtype=torch.float64, seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Return predicted images close to the true ones, true images (partly out of range) in linear RGB, and masks."""
    generator = torch.Generator().manual_seed(seed)
    true = 1.2 * torch.rand(shape, generator=generator, dtype=dtype) - 0.1
    near = true + 0.1 * torch.randn(shape, generator=generator, dtype=dtype)
    return near, true, torch.rand(shape[:3], generator=generator) < 0.4


def compute_metric(metric, *predictions: Prediction) -> dict[str, float]:
    for prediction in predictions:
        metric.update(prediction)
    return {key: value.item() for key, value in metric.compute().items()}


def file_numbers(light: Tensor, encoding: str) -> np.ndarray:
    """Return sRGB by kornia, or linear RGB, clipped to [0, 1]."""
    light = light.double().clamp(0, 1)
    if encoding == "srgb":
        light = kornia.color.linear_rgb_to_rgb(light.movedim(-1, 1)).movedim(1, -1)
    return light.numpy()


@pytest.mark.parametrize("dtype, limit", [(torch.float32, 1e-5), (torch.float64, 1e-9)])
@pytest.mark.parametrize("encoding", ["srgb", "linear"])
def test_psnr_is_a_mean_of_decibels_over_the_frame_and_inside_the_mask(encoding, dtype, limit):
    near, true, mask = random_images(5, 9, 7, 3, dtype=dtype)
    near[0] = 0.3  # a mean of decibels differs from the decibels of the mean error
    actual = compute_metric(build_metric("psnr", encoding=encoding), colors(near, true, mask))
    predicted, expected = (file_numbers(image, encoding) for image in (near, true))
    squares = (predicted - expected) ** 2
    whole = [-10 * math.log10(square.mean()) for square in squares]
    inside = [
        -10 * math.log10(square[part].mean()) for square, part in zip(squares, mask.numpy(), strict=True)
    ]
    for key, numbers in {"psnr_db": whole, "psnr_masked_db": inside}.items():
        assert actual[key] == pytest.approx(np.mean(numbers), rel=limit)
        assert actual[f"{key}_sem"] == pytest.approx(sem(numbers), rel=100 * limit)
    assert abs(actual["psnr_db"] + 10 * math.log10(squares.mean())) > 1
    assert actual["psnr_exact"] == 0
    only = compute_metric(build_metric("psnr", encoding=encoding, masked=False), colors(near, true))
    assert only == {key: value for key, value in actual.items() if "masked" not in key}


def test_perfect_images_count_with_the_ceiling():
    near, true, mask = random_images(4, 6, 5, 3)
    near[1:3] = true[1:3]
    near[3, ~mask[3]] = true[3, ~mask[3]] + 0.05
    near[3, mask[3]] = true[3, mask[3]]
    imperfect = compute_metric(build_metric("psnr"), colors(near[[0, 3]], true[[0, 3]], mask[[0, 3]]))
    for ceiling in (100.0, 70.0):
        actual = compute_metric(build_metric("psnr", ceiling_db=ceiling), colors(near, true, mask))
        assert actual["psnr_db"] == pytest.approx((2 * imperfect["psnr_db"] + 2 * ceiling) / 4)
        assert actual["psnr_exact"] == 0.5
        assert all(math.isfinite(number) for number in actual.values())
    with pytest.raises(ConfigError, match="ceiling_db"):
        resolve("metric", {"name": "psnr", "ceiling_db": math.inf})


def window() -> np.ndarray:
    place = np.arange(11) - 5
    bell = np.exp(-(place[:, None] ** 2 + place[None] ** 2) / (2 * 1.5**2))
    return bell / bell.sum()


def ssim_of_windows(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return SSIM, and its contrast and structure, of every window of one channel, one window at a time.

    Moments are central moments.
    """
    weights, (height, width) = window(), first.shape
    whole, contrast = np.zeros((2, height - 10, width - 10))
    for row in range(height - 10):
        for column in range(width - 10):
            x, y = (image[row : row + 11, column : column + 11] for image in (first, second))
            mean_x, mean_y = (weights * x).sum(), (weights * y).sum()
            covariance = (weights * (x - mean_x) * (y - mean_y)).sum()
            variances = (weights * ((x - mean_x) ** 2 + (y - mean_y) ** 2)).sum()
            contrast[row, column] = (2 * covariance + 0.03**2) / (variances + 0.03**2)
            means = (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2)
            whole[row, column] = means * contrast[row, column]
    return whole, contrast


@pytest.mark.parametrize("dtype, limit", [(torch.float32, 1e-5), (torch.float64, 1e-11)])
def test_ssim_equals_a_loop_over_windows(dtype, limit):
    near, true, mask = random_images(2, 16, 14, 3, dtype=dtype)
    mask[1, 5:-5, 5:-5] = False  # no window of this image is centred on a pixel of the mask
    actual = compute_metric(build_metric("ssim"), colors(near, true, mask))
    predicted, expected = (file_numbers(image, "srgb") for image in (near, true))
    maps = np.stack(
        [
            [ssim_of_windows(x[..., c], y[..., c])[0] for c in range(3)]
            for x, y in zip(predicted, expected, strict=True)
        ]
    )
    assert actual["ssim"] == pytest.approx(maps.mean(), rel=limit)
    assert actual["ssim_sem"] == pytest.approx(sem(maps.mean((1, 2, 3))), rel=1e3 * limit)
    assert actual["ssim_masked"] == pytest.approx(maps[0][:, mask[0, 5:-5, 5:-5].numpy()].mean(), rel=limit)
    assert math.isnan(actual["ssim_masked_sem"])
    # torchmetrics also averages over reflected borders; its windows inside the image are the same
    pair = [torch.from_numpy(image).movedim(-1, 1) for image in (predicted, expected)]
    theirs = structural_similarity_index_measure(*pair, data_range=1.0, return_full_image=True)[1]
    np.testing.assert_allclose(theirs[..., 5:-5, 5:-5].numpy(), maps, rtol=1e-9)


def ssim_by_convolution(first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the results of `ssim_of_windows`, computed by SciPy's convolution for larger images."""
    mean_x, mean_y, x, y, product = (
        convolve2d(image, window(), mode="valid")
        for image in (first, second, first**2, second**2, first * second)
    )
    variances = x - mean_x**2 + y - mean_y**2
    contrast = (2 * (product - mean_x * mean_y) + 0.03**2) / (variances + 0.03**2)
    return (2 * mean_x * mean_y + 0.01**2) / (mean_x**2 + mean_y**2 + 0.01**2) * contrast, contrast


def halve_image(image: np.ndarray) -> np.ndarray:
    """Return every second pixel of the authors' 2 × 2 filter with mirrored edges, starting with the first."""
    filtered = ndimage.correlate(image, np.full((2, 2), 0.25), mode="reflect", origin=-1)
    return filtered[::2, ::2]


@pytest.mark.parametrize(
    "scales, size, reference",
    [
        (1, (12, 11), ssim_of_windows),
        (2, (23, 26), ssim_of_windows),
        (3, (45, 47), ssim_of_windows),
        (5, (177, 183), ssim_by_convolution),
    ],
)
def test_ms_ssim_is_a_product_over_scales(scales, size, reference):
    near, true, _ = random_images(3, *size, 2)
    near[1], near[2] = 1 - true[1], true[2]  # image 1 has negative contrasts; image 2 is perfect
    metric = build_metric("ms_ssim", scales=scales, encoding="linear")
    actual = compute_metric(metric, colors(near, true))
    weights = np.array([0.0448, 0.2856, 0.3001, 0.2363, 0.1333])
    share = weights[:scales] * weights.sum() / weights[:scales].sum()
    by_channel = []
    for channel in range(2):
        pair = [image[0, ..., channel].clamp(0, 1).numpy() for image in (near, true)]
        factors = []
        for scale in range(scales):
            whole, contrast = reference(*pair)
            factors.append((whole if scale == scales - 1 else contrast).mean())
            pair = [halve_image(image) for image in pair]
        by_channel.append(np.prod(np.array(factors) ** share))
    assert metric.numbers[0][:, 0].tolist() == pytest.approx([np.mean(by_channel), 0, 1], rel=1e-9, abs=1e-12)
    assert actual["ms_ssim"] == pytest.approx((np.mean(by_channel) + 1) / 3, rel=1e-9)
    assert functional.least_side(scales) == 11 * 2 ** (scales - 1) <= min(size)


def predict_images(**fields: Tensor) -> Prediction:
    """Return a prediction with predicted images `predicted_<channel>` and true images `<channel>`."""
    inside = {name.removeprefix("predicted_"): field for name, field in fields.items() if "_" in name}
    truth = {name: field for name, field in fields.items() if "_" not in name}
    count = len(next(iter(truth.values())))
    prediction = Prediction(
        simplest_density(PLACE, torch.zeros(count, 2)), {"index": torch.arange(count), **truth}
    )
    prediction._images.update(inside)
    return prediction


def test_silhouettes_equal_a_computation_by_hand():
    true = torch.tensor([[[1, 1, 0], [1, 0, 0]], [[0, 0, 0]] * 2, [[0, 0, 0]] * 2, [[1, 1, 1]] * 2]).bool()
    predicted = torch.tensor(
        [[[0, 1, 1], [1, 1, 0]], [[0, 0, 0]] * 2, [[0, 1, 0]] * 2, [[1, 1, 1]] * 2]
    ).bool()
    actual = compute_metric(
        build_metric("silhouette_iou"), predict_images(mask=true, predicted_mask=predicted)
    )
    # IoU 2/5; both masks empty (does not count); true mask empty (0); identical masks (1)
    assert actual["silhouette_iou"] == pytest.approx((2 / 5 + 0 + 1) / 3)
    assert actual["silhouette_iou_sem"] == pytest.approx(sem([2 / 5, 0, 1]))
    nothing = compute_metric(
        build_metric("silhouette_iou"), predict_images(mask=true[1:2], predicted_mask=true[1:2])
    )
    assert all(math.isnan(number) for number in nothing.values())


def test_depths_equal_a_computation_by_hand():
    far = math.inf
    true = torch.tensor([[[1.0, 2.0, far, far]], [[far, far, 5.0, far]], [[far] * 4]])
    predicted = torch.tensor([[[1.5, 1.75, 3.0, far]], [[far, 4.0, far, far]], [[far] * 4]])
    actual = compute_metric(
        build_metric("depth_error"), predict_images(depth=true, predicted_depth=predicted)
    )
    assert actual["depth_error_m"] == pytest.approx((0.5 + 0.25) / 2)  # the other images have no common pixel
    assert actual["depth_unmatched"] == pytest.approx(
        (1 / 3 + 1) / 2
    )  # both depths of the last image are empty
    assert math.isnan(actual["depth_error_m_sem"])


@pytest.mark.parametrize("name", NAMES)
def test_batch_sizes_change_no_bit_and_one_pixel_is_an_image(name):
    config = {"scales": 1} if name == "ms_ssim" else {}
    size = (11, 12) if "ssim" in name else (1, 1)
    place = torch.linspace(-1, 1, 14).reshape(7, 2)

    def predict_balls(part: Tensor) -> Prediction:
        density = simplest_density(PLACE, place[part] / 2)
        return Prediction(
            Ball(density, place[part] / 2, size), {"index": part, **ball(place[part], size)}, reads={"color"}
        )

    actual = [
        compute_metric(
            build_metric(name, **config), *(predict_balls(part) for part in torch.arange(7).split(count))
        )
        for count in (7, 3, 1)
    ]
    assert not any(math.isnan(number) for number in actual[0].values())
    assert actual[0] == actual[1] == actual[2]


def test_images_that_cannot_be_compared_raise_a_clear_message():
    near, true, mask = random_images(3, 12, 12, 3)
    psnr = build_metric("psnr")
    with pytest.raises(DataError, match=r"true 'color'.*batches have only index"):
        psnr.update(Prediction(image_density(near), {"index": torch.arange(3)}))
    with pytest.raises(DataError, match=r"requires the batch field 'mask'.*Set `masked` to false"):
        psnr.update(colors(near, true))
    with pytest.raises(DataError, match=r"masks are float64 \(3, 12, 12\), expected bool"):
        psnr.update(colors(near, true, mask.double()))
    with pytest.raises(
        DataError, match=r"float64 \(3, 12, 12, 3\) and true 'color' of float64 \(3, 12, 12, 1\)"
    ):
        psnr.update(colors(near, true[..., :1], mask))
    with pytest.raises(DataError, match=r"true 'color' of uint8 .*linear RGB, not 8-bit"):
        psnr.update(colors(near, bytes_from_linear(true), mask))
    for wrong in (math.nan, math.inf, -math.inf):
        bad = near.clone()
        bad[1, 3, 4, 0] = wrong
        with pytest.raises(
            DataError, match=r"1 numbers of predicted 'color' that are NaN or infinite.*row 1"
        ):
            psnr.update(colors(bad, true, mask))
        with pytest.raises(DataError, match="1 numbers of true 'color'"):
            psnr.update(colors(near, bad, mask))
    depth = torch.full((2, 1, 1), math.inf)
    for wrong in (math.nan, -math.inf):
        with pytest.raises(DataError, match=r"predicted 'depth'.*or \+inf"):
            build_metric("depth_error").update(
                predict_images(depth=depth, predicted_depth=torch.full((2, 1, 1), wrong))
            )
    with pytest.raises(DataError, match=r"10 × 12 pixels.*at least 11 pixels"):
        build_metric("ssim").update(colors(near[:, :10], true[:, :10], mask[:, :10]))
    with pytest.raises(DataError, match=r"12 × 12 pixels.*at least 176 pixels.*fewer `scales`"):
        build_metric("ms_ssim").update(colors(near, true))
    with pytest.raises(UserError, match=r"MultivariateNormal of event_shape \(2,\) provides no color"):
        psnr.update(
            Prediction(simplest_density(PLACE, torch.zeros(2, 2)), {"color": true, "index": torch.arange(2)})
        )


def test_srgb_has_a_gradient_and_is_clipped():
    light = torch.tensor([0.0, 1e-4, 0.0031308, 0.01, 0.5, 1.0], dtype=torch.float64, requires_grad=True)
    theirs = kornia.color.linear_rgb_to_rgb(light.detach().expand(3, 1, 6))[0, 0]
    torch.testing.assert_close(srgb_from_linear(light).detach(), theirs, rtol=0, atol=1e-8)
    (slope,) = torch.autograd.grad(srgb_from_linear(light).sum(), light)
    assert slope.isfinite().all() and (slope > 0).all()
    assert torch.autograd.gradcheck(srgb_from_linear, light.detach()[[1, 3, 4]].requires_grad_())
    assert srgb_from_linear(torch.tensor([-1.0, 2.0])).tolist() == pytest.approx([0, 1], abs=1e-7)


def test_the_choice_of_images_does_not_depend_on_their_order():
    generator = torch.Generator().manual_seed(0)
    facts = torch.stack([torch.randn(200, generator=generator), torch.arange(200.0)], -1).double()
    facts[7, 0] = math.nan
    wanted = {tuple(fact) for fact in facts[choose_images(facts)].tolist()}
    assert len(wanted) <= KEPT + 2
    assert {min(facts[:, 0].nan_to_num(9)).item(), max(facts[:, 0].nan_to_num(-9)).item()} <= {
        score for score, _ in wanted
    }
    for seed in range(3):
        order = torch.randperm(200, generator=torch.Generator().manual_seed(seed))
        kept_facts = facts[:0]
        for part in order.split(17):
            kept_facts = torch.cat([kept_facts, facts[part]])
            kept_facts = kept_facts[choose_images(kept_facts)]
        assert {tuple(fact) for fact in kept_facts.tolist()} == wanted


@pytest.mark.parametrize("name", NAMES)
def test_the_sheet_shows_worst_median_and_best(name):
    metric = build_metric(name, **({"scales": 2} if name == "ms_ssim" else {}))
    place, size = torch.linspace(-1, 1, 14).reshape(7, 2), (24, 22)
    off = torch.tensor([3.0, 0.0, 5.0, 1.0, 6.0, 4.0, 2.0])[:, None] / 6
    for part in torch.arange(7).split(2):
        predicted = place[part] + off[part]
        density = Ball(simplest_density(PLACE, predicted), predicted, size)
        metric.update(Prediction(density, {"index": part, **ball(place[part], size)}))
    metric.compute()
    figure = metric.figure("balls", synthetic=True)
    captions = [axes.get_ylabel().split("\n")[0] for axes in figure.axes if axes.get_ylabel().count("image ")]
    assert captions == ["worst: image 4", "near the median: image 0", "best: image 1"]
    figure.canvas.draw()
    assert "of 7 images" in figure.get_supxlabel()
    empty = build_metric(name).figure("nothing", synthetic=False)
    assert [text.get_text() for text in empty.texts][-1].startswith("no image has a ")
