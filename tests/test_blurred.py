"""The Gaussian blur of images (framework.datasets.images), against SciPy's."""

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from scipy.ndimage import gaussian_filter

from framework.datasets.images import Crop, blur


@pytest.mark.parametrize("deviation", [0.1, 0.5, 1.0, 2.3, 8.0, 40.0])
@pytest.mark.parametrize("size", [(1, 1), (5, 9), (50, 50), (75, 40)])
def test_blur_is_scipys(deviation: float, size: tuple[int, int]) -> None:
    """The kernel may be several times larger than the image."""
    pixels = np.random.default_rng(0).random((2, 3, *size))
    expected = gaussian_filter(pixels, (0, 0, deviation, deviation), mode="reflect", truncate=4)
    np.testing.assert_allclose(blur(torch.from_numpy(pixels), deviation), expected, atol=1e-13)
    single = blur(torch.from_numpy(pixels).float(), deviation)
    assert single.dtype == torch.float32
    np.testing.assert_allclose(single, expected, atol=1e-6)


def test_whole_numbers_are_rounded() -> None:
    pixels = np.random.default_rng(1).integers(0, 256, (3, 20, 30), dtype=np.uint8)
    pixels[:, :10] = 255
    expected = gaussian_filter(pixels.astype(float), (0, 1.7, 1.7), mode="reflect", truncate=4)
    result = blur(torch.from_numpy(pixels), 1.7)
    assert result.dtype == torch.uint8
    assert abs(result.numpy() - expected).max() < 0.501


def test_no_blur_is_the_same_tensor_and_a_flat_image_stays_flat() -> None:
    pixels = torch.randint(0, 256, (3, 8, 8), dtype=torch.uint8)
    assert blur(pixels, 0.0) is pixels
    flat = torch.full((3, 7, 11), 255, dtype=torch.uint8)
    for deviation in (1e-300, 0.3, 3.0, 300.0):
        assert torch.equal(blur(flat, deviation), flat)
    assert torch.equal(blur(pixels, 0.1), pixels)  # a kernel of one pixel


def test_crop_is_blurred_after_it_was_scaled(tmp_path: Path) -> None:
    pixels = np.random.default_rng(2).integers(0, 256, (40, 40, 3), dtype=np.uint8)
    Image.fromarray(pixels).save(tmp_path / "one.png")
    sharp = Crop(tmp_path / "one.png", None, 0.0, 20).read()
    smooth = Crop(tmp_path / "one.png", None, 0.0, 20, blur=1.5).read()
    assert torch.equal(smooth, blur(sharp, 1.5))
    assert not torch.equal(smooth, sharp)
