"""Contract-test cases: the smallest network, trained and frozen, with small images, because each check takes seconds.

The comparison of the deeper networks with torchvision's features is in test_resnet.py.
"""

from framework.testing.rows import EncoderRow

ROWS = {
    "resnet": (
        EncoderRow("colour", (3, 35, 33)),
        EncoderRow("grey, frozen", (1, 32, 32), {"frozen": True}),
    )
}
