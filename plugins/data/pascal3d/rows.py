"""Contract-test cases: a few generated cars, alone and with bottles."""

from dataclasses import replace

from framework.testing.rows import DAMAGES, DataRow
from framework.testing.sample_files import images

CARS = DataRow(
    "cars",
    {"images": 30, "image_size": 16, "include_occluded": True},
    synthetic=True,
    files=images,
    fragile={
        "Images/car_imagenet/*.JPEG": DAMAGES,
        "Annotations/car_imagenet/*.mat": DAMAGES,
        "Image_sets/car_imagenet_train.txt": ("missing", "garbage", "folder"),
    },
    skip={"skip_unreadable": True},
    changes={"generator_seed": 1, "validation_share": 0.4},
)
ROWS = {
    "pascal3d": (
        CARS,
        replace(
            CARS,
            name="two classes, not varied",
            config={
                "images": 24,
                "image_size": 8,
                "category": ["car", "bottle"],
                "mirror": False,
                "jitter": 0.0,
            },
            fragile={},
            skip={},
            leave_out={"official layout read back": "each class is generated into its own root"},
        ),
    )
}
