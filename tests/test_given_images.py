"""Images in memory, which give the same inputs as the same images in files."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from PIL import Image

from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.errors import DataError

SIDE = 16


@pytest.fixture
def data() -> Data:
    found: Data = build("data", resolve("data", {"name": "images_with_angles", "image_size": SIDE}))
    found.input_shape = (3, SIDE, SIDE)
    return found


def picture(height: int, width: int) -> np.ndarray:
    return np.random.default_rng(0).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.parametrize("size", [(16, 16), (40, 30), (7, 50), (3, 3)])
def test_an_image_is_read_alike_from_a_file_from_pillow_and_from_an_array(
    size: tuple[int, int], data: Data, tmp_path: Path
) -> None:
    pixels = picture(*size)
    Image.fromarray(pixels).save(tmp_path / "it.png")
    wanted = data.inputs(tmp_path / "it.png")
    assert wanted.shape == (1, 3, SIDE, SIDE) and wanted.dtype == torch.uint8
    alpha = np.dstack([pixels, np.full(size, 255, np.uint8)])
    given: list[Any] = [
        str(tmp_path / "it.png"),
        Image.open(tmp_path / "it.png"),
        pixels,
        torch.from_numpy(pixels),
        alpha,
    ]
    for one in given:
        assert torch.equal(data.inputs(one), wanted)
    several: list[Any] = [[tmp_path / "it.png"] * 2, [Image.fromarray(pixels)] * 2, np.stack([pixels] * 2)]
    for one in several:
        assert torch.equal(data.inputs(one), wanted.expand(2, -1, -1, -1))
    grey = Image.fromarray(pixels).convert("L")
    assert torch.equal(data.inputs(grey), data.inputs(np.asarray(grey)))
    assert torch.equal(data.inputs(grey), data.inputs(np.asarray(grey)[..., None]))


def test_inputs_of_the_model_are_taken_as_they_are(data: Data) -> None:
    for inputs in (
        torch.randint(0, 256, (5, 3, SIDE, SIDE), dtype=torch.uint8),
        torch.rand(5, 3, SIDE, SIDE),
        torch.zeros(0, 3, SIDE, SIDE),
    ):
        assert torch.equal(data.inputs(inputs), inputs)
        assert torch.equal(data.inputs(inputs.numpy()), inputs)
    assert data.inputs(torch.rand(3, SIDE, SIDE)).shape == (1, 3, SIDE, SIDE)


@pytest.mark.parametrize(
    "given",
    [
        255 * torch.rand(2, 3, SIDE, SIDE),
        torch.full((2, 3, SIDE, SIDE), torch.nan),
        np.random.default_rng(0).random((40, 30, 3)),
        np.zeros((2, 3, 40, 30), np.uint8),
        np.zeros((40, 30, 2), np.uint8),
        np.zeros(SIDE, np.uint8),
        object(),
        [],
        "",
        [picture(4, 4), "it.png"],
    ],
    ids=lambda given: type(given).__name__,
)
def test_what_is_no_image_is_refused(given: Any, data: Data) -> None:
    with pytest.raises(DataError, match=r"[Ee]xpected|[Gg]ive|required|reads|Copy|Name a file"):
        data.inputs(given)
