"""Tests of mode=predict with other data settings than in the run, which change the reading or are refused."""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
import torch
from PIL import Image

from framework.data import Data
from framework.datasets.fields import Fields
from framework.runs.session import _count_equal_samples
from tests.conftest import Framework

QUIET = ("logger=none", "threads=1")
SMALL = (
    "encoder=[mlp]",
    "encoder.mlp.widths=[4]",
    "trainer.max_epochs=1",
    "batch_size=20",
    "pictures=false",
    *QUIET,
)


def table(folder: Path) -> tuple[list[str], Path, dict[str, str | None]]:
    """A run on a table, a file to predict for, and settings with what is said of them; None where they are used."""
    random = np.random.default_rng(0)
    rows = [f"{a:.3f},{b:.3f},{a + b:.3f},{'uv'[n % 2]}" for n, (a, b) in enumerate(random.random((60, 2)))]
    file = folder / "people.csv"
    file.write_text("\n".join(["width,height,age,label", *rows]))
    data = f"data=tabular data.path={file} data.target=age data.kind=real data.columns=[width,height]"
    same = "in the same way without it"
    return (
        [*data.split(), "density_head=gaussian", "metric=[rmse]"],
        file,
        {
            "data.path=nowhere.csv": same,
            "data.columns=[width]": same,
            "data=moons": "Give the data that the model was trained on",
        },
    )


def images(folder: Path) -> tuple[list[str], Path, dict[str, str | None]]:
    """The same of pictures."""
    random = np.random.default_rng(0)
    root = folder / "pictures"
    root.mkdir()
    for number in range(41):
        pixels = random.integers(0, 255, (24, 24, 3), dtype=np.uint8)
        Image.fromarray(pixels).save((root if number < 40 else folder) / f"{number:02}.png")
    lines = [f"{number:02}.png,{9 * number}" for number in range(40)]
    (root / "angles.csv").write_text("\n".join(["file,angle", *lines]))
    data = ["data=images_with_angles", f"data.root={root}", "data.image_size=16"]
    return (
        [*data, "density_head=von_mises", "metric=[angular_deviation]"],
        folder / "40.png",
        {
            f"data.root={root}": "in the same way without it",
            "data.image_size=16": "in the same way without it",
            "data.image_size=32": "reads inputs of shape",
        },
    )


@pytest.mark.parametrize(
    ("differs", "expected"), [(-1, 1024), (9, None), (99, None), (900, None), (1050, 1024)]
)
def test_a_setting_that_changes_any_compared_sample_has_an_effect(differs: int, expected: int | None) -> None:
    def reading(changed: int) -> Callable[[Sequence[Path]], Fields]:
        """Return a function that reads ten samples from each file; the number `changed` is read as -2."""

        def read(files: Sequence[Path]) -> Fields:
            numbers = torch.tensor([10 * int(file.name) + row for file in files for row in range(10)])
            return Fields(input=torch.where(numbers == changed, -2, numbers))

        return read

    files = [Path(str(number)) for number in range(200)]
    stored = cast(Data, SimpleNamespace(read=reading(-1)))
    assert _count_equal_samples(stored, reading(differs), files) == expected
    assert _count_equal_samples(stored, reading(differs), files[:5]) == (None if differs == 9 else 50)


@pytest.mark.parametrize(
    "kind", [pytest.param(table, id="table"), pytest.param(images, id="images", marks=pytest.mark.slow)]
)
def test_a_setting_of_the_data_changes_what_is_read_or_is_refused(
    kind: object, framework: Framework, tmp_path: Path
) -> None:
    command, file, settings = kind(tmp_path)  # type: ignore[operator]
    run = framework(*command, *SMALL, folder="run")
    assert run.code == 0, run.out
    predict = ("mode=predict", f"checkpoint={run.folder}", f"mode.files={file}", *QUIET)
    plain = framework(*predict, folder="plain")
    assert plain.code == 0, plain.out
    for setting, wanted in settings.items():
        done = framework(*predict, setting, folder="again")
        assert "Traceback" not in done.out
        if wanted is None:
            assert done.code == 0, done.out
            continue
        assert done.code in (1, 2) and wanted in done.out, (setting, done.out)
