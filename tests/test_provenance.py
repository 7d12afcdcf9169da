"""Tests of the provenance of a result."""

from importlib.metadata import version

from hypothesis import given, settings
from hypothesis import strategies as st

from framework.runs.provenance import flatten, package_versions


def test_versions_name_what_a_result_rests_on() -> None:
    found = package_versions()
    assert found["torch"] == version("torch")
    assert found["hydra-core"] == version("hydra-core")
    assert found["robust-visual-learning"] == version("robust-visual-learning")  # it provides plugins
    assert found["python"].startswith("3.")


def test_a_config_is_flattened_to_dotted_keys() -> None:
    config = {
        "seed": 0,
        "head": {"name": "mixture", "parts": [{"n": 1}, {"n": 2}]},
        "sizes": [1, 2],
        "e": {},
        "l": [],
    }
    assert flatten(config) == {
        "seed": 0,
        "head.name": "mixture",
        "head.parts.0.n": 1,
        "head.parts.1.n": 2,
        "sizes": [1, 2],
        "e": {},
        "l": [],
    }
    assert flatten({}) == {}
    assert flatten({"text": "abc", "bytes": None}) == {"text": "abc", "bytes": None}


plain = st.none() | st.booleans() | st.integers() | st.text(max_size=3)
trees = st.recursive(
    plain,
    lambda child: (
        st.lists(child, max_size=3) | st.dictionaries(st.text("abc", min_size=1, max_size=2), child)
    ),
)


@settings(deadline=None, max_examples=100)
@given(st.dictionaries(st.text("abc", min_size=1, max_size=2), trees, max_size=4))
def test_flatten_loses_nothing(config: dict[str, object]) -> None:
    for key, leaf in flatten(config).items():
        node: object = config
        for part in key.split("."):
            node = node[int(part)] if isinstance(node, list) else node[part]  # type: ignore[index]
        assert node == leaf

    def count(node: object) -> int:
        if isinstance(node, dict) and node:
            return sum(map(count, node.values()))
        if isinstance(node, list) and any(isinstance(item, dict | list) for item in node):
            return sum(map(count, node))
        return 1

    assert len(flatten(config)) == (count(config) if config else 0)
