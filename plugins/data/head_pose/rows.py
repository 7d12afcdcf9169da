"""Contract-test cases: a few generated heads of each data set, in its official layout."""

from functools import partial

from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import images

SIZES = {"images": 30, "image_size": 12}
SKIP = {"skip_unreadable": True}
CHANGES = {"generator_seed": 1, "images": 31}
generated_row = partial(DataRow, synthetic=True, files=images)
ROWS = {
    "idiap": (
        generated_row(
            "three angles",
            SIZES,
            fragile={"train/*.jpg": DAMAGES, "or_label_full.mat": DAMAGES},
            skip=SKIP,
            changes={**CHANGES, "angles": ["roll", "pan"]},
        ),
        generated_row(
            "tilt, blurred, not varied",
            {**SIZES, "angles": ["tilt"], "test_blur": 1.0, "jitter": 0.0},
            changes={"test_blur": 2.0},
        ),
    ),
    "towncentre": (
        generated_row(
            "mirrored",
            {"images": 200, "image_size": 12},
            # a missing image is noticed because its label exists; a missing label cannot be noticed
            fragile={
                "0001/*.jpg": ("empty", "cut", "garbage", "folder"),
                "0001/*.txt": ("empty", "cut", "garbage", "folder"),
            },
            skip=SKIP,
            changes={"generator_seed": 1, "images": 201},
        ),
    ),
    "caviar": (
        generated_row(
            "gaze",
            SIZES,
            fragile={"train/*.jpg": DAMAGES, "or_label.mat": DAMAGES},
            skip=SKIP,
            changes=CHANGES,
        ),
    ),
}
