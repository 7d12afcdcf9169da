"""Rows of the contract: one, of grey images as small as may be: each check takes seconds.

Colour, against timm's features, is in test_inception_resnet_v2.py.
"""

from framework.testing.rows import EncoderRow

ROWS = {"inception_resnet_v2": (EncoderRow("grey", (1, 96, 80)),)}
