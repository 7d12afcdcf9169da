"""Contract-test cases: images of noise, in colour and mirrored, or grey with splits from the table."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import images, noise_image


def write(folder: Path, split: bool = False) -> Mapping[str, str]:
    """Write forty images and a table of their angles, degrees; return the settings that name the folder.

    If `split` is true, the table also names the split of each image.
    """
    lines = ["file,pan,tilt" + ",split" * split]
    for number in range(40):
        file = noise_image(folder / f"{number:03d}.png", number)
        part = ("train", "validation", "test")[number % 3]
        pan = 10 * number if number >= 30 else number / 8  # acceptable as degrees and as radians
        lines.append(f"{file.name},{pan},{-number / 4}" + f",{part}" * split)
    (folder / "angles.csv").write_text("\n".join(lines), encoding="utf-8")
    return {"root": str(folder)}


MIRRORED = DataRow(
    "mirrored",
    {"image_size": 8, "mirror": ["pan"]},
    write=write,
    synthetic=False,
    files=images,
    fragile={"*.png": DAMAGES, "angles.csv": DAMAGES},
    skip={"skip_unreadable": True},
    changes={"angle_columns": ["pan"], "angles_in": "radians"},
)
GREY = replace(
    MIRRORED,
    name="grey, not varied",
    config={"image_size": 9, "grayscale": True, "jitter": 0.0},
    write=lambda folder: write(folder, split=True),
)
ROWS = {"images_with_angles": (MIRRORED, GREY)}
