"""Contract-test cases: only one, with small grey images, because each check takes seconds.

The comparison of colour images with timm's features is in test_inception_resnet_v2.py.
"""

from framework.testing.rows import EncoderRow

ROWS = {"inception_resnet_v2": (EncoderRow("grey", (1, 96, 80)),)}
