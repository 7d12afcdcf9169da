"""Tests of LPIPS with random weights, compared with its formula in float64 and with torchmetrics."""

import math
from pathlib import Path

import pytest
import torch
import torchmetrics
from torch import Tensor
from torch.nn.functional import conv2d, max_pool2d
from torchmetrics.functional.image import lpips as theirs

from framework.configuration.schema import build, resolve
from framework.errors import CheckpointError, ConfigError, DataError
from framework.geometry.srgb import srgb_from_linear
from framework.testing.finding import require
from framework.testing.metrics import examine_metric
from framework.testing.rows import MetricRow
from plugins.metric.images.test_images import PLACE, colors, compute_metric, random_images

# torchvision's layers: number, input, output and kernel of each convolution, its stride and padding
LAYERS = {
    "alex": [(0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3)],
    "vgg": [
        *((0, 3, 64, 3), (2, 64, 64, 3), (5, 64, 128, 3), (7, 128, 128, 3), (10, 128, 256, 3)),
        *((12, 256, 256, 3), (14, 256, 256, 3), (17, 256, 512, 3), (19, 512, 512, 3), (21, 512, 512, 3)),
        *((24, 512, 512, 3), (26, 512, 512, 3), (28, 512, 512, 3)),
    ],
}
COMPARED = {"alex": (0, 3, 6, 8, 10), "vgg": (2, 7, 14, 21, 28)}
POOLED = {"alex": {0: 3, 3: 3}, "vgg": {2: 2, 7: 2, 14: 2, 21: 2}}
"""Convolutions after which there is a pooling, and its side; the stride is 2."""
HEADS = Path(torchmetrics.__file__).parent / "functional/image/lpips_models"


def weights(backbone: str, seed: int = 0) -> dict[str, Tensor]:
    """Return random weights of all feature layers, with torchvision's names."""
    generator = torch.Generator().manual_seed(seed)
    actual = {}
    for number, before, width, side in LAYERS[backbone]:
        spread = math.sqrt(2 / (before * side * side))
        draw = torch.randn(width, before, side, side, generator=generator)
        actual[f"features.{number}.weight"] = spread * draw
        actual[f"features.{number}.bias"] = 0.1 * torch.randn(width, generator=generator)
    return actual


def write_weights(folder: Path, state: dict[str, Tensor]) -> str:
    torch.save(state, folder / "weights.pth")
    return str(folder / "weights.pth")


def distance_by_formula(backbone: str, state: dict[str, Tensor], first: Tensor, second: Tensor) -> float:
    """Return eq. 1 of Zhang et al. 2018 for two images (3, height, width) in [0, 1], float64."""
    heads = torch.load(HEADS / f"{backbone}.pth", weights_only=True, map_location="cpu")
    shift, scale = (
        torch.tensor(numbers, dtype=torch.float64)[:, None, None]
        for numbers in ((-0.030, -0.088, -0.188), (0.458, 0.448, 0.450))
    )
    maps = [(2 * image[None].double() - 1 - shift) / scale for image in (first, second)]
    total = 0.0
    for number, *_, side in LAYERS[backbone]:
        weight, bias = (state[f"features.{number}.{part}"].double() for part in ("weight", "bias"))
        stride, padding = (4, 2) if side == 11 else (1, side // 2)
        maps = [conv2d(image, weight, bias, stride, padding).clamp(min=0) for image in maps]
        if number in COMPARED[backbone]:
            head = heads[f"lin{COMPARED[backbone].index(number)}.model.1.weight"].double()
            unit = [image / image.square().sum(1, keepdim=True).sqrt() for image in maps]
            # w of the equation is the root of the stored weight
            gap = (head.sqrt() * (unit[0] - unit[1])).square().sum(1)
            total += float(gap.sum() / gap.numel())
        if number in POOLED[backbone]:
            maps = [max_pool2d(image, POOLED[backbone][number], 2) for image in maps]
    return total


def lpips(**config):
    return build("metric", resolve("metric", {"name": "lpips", **config}), target=PLACE)


@pytest.mark.parametrize("backbone, size", [("alex", (33, 40)), ("vgg", (16, 21))])
@pytest.mark.parametrize("whole", [True, False])
def test_lpips_equals_its_formula_over_the_image_and_on_white(backbone, size, whole, tmp_path, monkeypatch):
    """Check files with all of torchvision's layers, and files with only the features."""
    state = weights(backbone)
    if whole:
        file = write_weights(tmp_path, {**state, "classifier.1.weight": torch.zeros(4, 9)})
    else:
        file = write_weights(tmp_path, {name.removeprefix("features."): part for name, part in state.items()})
    near, true, mask = random_images(2, *size, 3)
    mask[1] = False
    metric = lpips(backbone=backbone, weights=file)
    actual = compute_metric(metric, colors(near, true, mask))
    predicted, expected = (srgb_from_linear(image).movedim(-1, 1) for image in (near, true))
    frame = [distance_by_formula(backbone, state, *pair) for pair in zip(predicted, expected, strict=True)]
    assert actual["lpips"] == pytest.approx(sum(frame) / 2, rel=1e-5)
    white = [torch.where(mask[0], image[0], 1.0) for image in (predicted, expected)]
    assert actual["lpips_masked"] == pytest.approx(distance_by_formula(backbone, state, *white), rel=1e-5)
    assert compute_metric(lpips(backbone=backbone, weights=file, masked=False), colors(near, true)) == {
        key: value for key, value in actual.items() if "masked" not in key
    }
    # let torchmetrics use the features of this metric, with torchvision's last pooling
    last = torch.nn.MaxPool2d(2)
    monkeypatch.setattr(theirs, "_get_tv_model_features", lambda *_: [*metric.distance.features, last])
    peer = theirs._LPIPS(net=backbone)(predicted.float(), expected.float(), normalize=True).flatten()
    assert peer.tolist() == pytest.approx(frame, rel=1e-4)


@pytest.mark.slow
def test_the_contract_tests_pass_with_weights(tmp_path):
    file = write_weights(tmp_path, weights("alex"))
    row = MetricRow("random weights", PLACE, {"weights": file}, size=(31, 33))
    require(*examine_metric(row, lambda: lpips(weights=file)))


def test_without_weights_the_result_is_nan():
    near, true, mask = random_images(2, 12, 12, 3)
    actual = compute_metric(lpips(), colors(near, true, mask))
    assert set(actual) >= {"lpips", "lpips_masked"}
    assert all(math.isnan(number) for number in actual.values())  # tables show NaN as "not available"


def test_unsuitable_images_and_weights_raise_a_clear_message(tmp_path):
    file = write_weights(tmp_path, weights("alex"))
    with pytest.raises(ConfigError, match="The weight file"):
        lpips(weights=str(tmp_path / "none.pth"))
    with pytest.raises(CheckpointError, match=r"does not fit VGG16: .*weights are missing"):
        lpips(backbone="vgg", weights=file)
    with pytest.raises(ConfigError, match="backbone"):
        lpips(backbone="squeeze")
    near, true, mask = random_images(1, 30, 40, 3)
    with pytest.raises(DataError, match=r"30 × 40 pixels with 3 channels, but .* at least 31 pixels"):
        lpips(weights=file).update(colors(near, true, mask))
    near, true, mask = random_images(1, 40, 40, 1)
    with pytest.raises(DataError, match="with 1 channels, but"):
        lpips(weights=file).update(colors(near, true, mask))
    assert lpips(weights=file).better == {"lpips": "lower", "lpips_masked": "lower"}
