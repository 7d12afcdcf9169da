import pytest

from framework.errors import ConfigError
from framework.target import Target


def test_few_names_are_told_in_full_and_of_very_many_the_first():
    assert Target("real", ("x", "y")).listed_names == "x, y"
    forty = tuple(f"class_{number}" for number in range(40))
    assert Target("class", forty).listed_names == ", ".join(forty)
    many = Target("real", tuple(f"v{number}" for number in range(41154)))
    assert many.listed_names == "v0, v1, v2, v3, v4, v5, v6, v7, v8, v9 and 41144 more"
    with pytest.raises(ConfigError, match=r"'angle', but .* 'real' \(v0, .* and 41144 more\)\. Choose"):
        many.require("angle", by="density_head von_mises")
