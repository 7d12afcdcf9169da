"""Contract-test cases: vectors and a flattened grid, before the scores are fitted."""

from framework.testing.rows import EncoderRow

ROWS = {"normal_scores": (EncoderRow("numbers", (7,)), EncoderRow("a grid", (3, 4)))}
