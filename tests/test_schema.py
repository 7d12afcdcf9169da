"""From constructor signatures to checked configs: every fault becomes a sentence."""

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import Field

import framework.configuration.schema as schema
from framework.configuration.schema import build, forbid_targets, resolve
from framework.encoder import Encoder
from framework.errors import ConfigError


class Toy(Encoder):
    """A class with every kind of parameter."""

    bibtex = ""

    def __init__(
        self,
        input_shape: tuple[int, ...],
        *,
        width: Annotated[int, Field(gt=0)] = 8,
        rate: Annotated[float, Field(ge=0, lt=1, allow_inf_nan=False)] = 0.5,
        kind: Literal["wide", "deep"] = "wide",
        inner: Encoder | None = None,
        others: list[Encoder] | None = None,
    ) -> None:
        super().__init__()
        self.input_shape = input_shape
        self.width, self.rate, self.kind, self.inner, self.others = width, rate, kind, inner, others
        self.output_shape = (width,)

    def forward(self, inputs: Any) -> Any:
        return inputs


@dataclass(frozen=True, kw_only=True)
class Frame:
    """A value: its fields are keys of the config."""

    side: Annotated[int, Field(ge=8)] = 48
    label: str
    inner: Encoder | None = None


class Framed(Toy):
    """A class of one value, whose default changes one of the value's own."""

    def __init__(
        self, input_shape: tuple[int, ...], *, width: int = 2, frame: Frame = Frame(side=75, label="as given")
    ) -> None:
        super().__init__(input_shape, width=width)
        self.frame = frame


class Demanding(Toy):
    """Asks the framework for something nobody has."""

    def __init__(self, moon: str) -> None:
        super().__init__((1,))


@pytest.fixture(autouse=True)
def toys(monkeypatch: pytest.MonkeyPatch) -> None:
    classes = {"toy": Toy, "demanding": Demanding, "framed": Framed}

    def load(group: str, name: str) -> type:
        if name not in classes:
            raise ConfigError(f"No {group} is called {name!r}.")
        return classes[name]

    monkeypatch.setattr(schema, "load", load)


def test_a_name_alone_takes_every_default() -> None:
    assert resolve("encoder", "toy") == {
        "name": "toy",
        "width": 8,
        "rate": 0.5,
        "kind": "wide",
        "inner": None,
        "others": None,
    }


def test_parts_are_resolved_and_built_with_the_same_context() -> None:
    resolved = resolve(
        "encoder", {"name": "toy", "inner": {"name": "toy", "width": 3}, "others": ["toy", "toy"]}
    )
    assert resolved["inner"]["width"] == 3
    built = build("encoder", resolved, input_shape=(2, 5))
    assert built.inner.width == 3
    assert built.inner.input_shape == (2, 5)
    assert [other.width for other in built.others] == [8, 8]


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            {"name": "toy", "widht": 3},
            r"encoder\.widht: unknown key\. Did you mean 'width'\? Known keys: width, rate",
        ),
        ({"name": "toy", "width": 0}, r"encoder\.width = 0: Input should be greater than 0"),
        ({"name": "toy", "width": "many"}, r"encoder\.width = 'many': Input should be a valid integer"),
        ({"name": "toy", "rate": float("nan")}, r"encoder\.rate = nan"),
        ({"name": "toy", "kind": "dep"}, r"Did you mean 'deep'\?"),
        ({"name": "toy", "inner": {"name": "toy", "width": -1}}, r"encoder\.inner\.width = -1"),
        ({"name": "toy", "others": ["toy", {"name": "toy", "rate": 2}]}, r"encoder\.others\[1\]\.rate = 2"),
        ({"name": "nobody"}, "No encoder is called 'nobody'"),
        ({"width": 3}, r"encoder\.name is missing"),
        (7, "wanted the name of a encoder"),
        ({"name": "toy", "inner": {"_target_": "os.system"}}, "_target_` is refused"),
    ],
)
def test_a_fault_becomes_a_sentence(config: Any, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        resolve("encoder", config)


def test_the_fields_of_a_value_are_keys_beside_the_others() -> None:
    assert resolve("encoder", "framed") == {
        "name": "framed", "width": 2, "side": 75, "label": "as given", "inner": None,
    }  # fmt: skip
    config = resolve("encoder", {"name": "framed", "label": "mine", "inner": "toy"})
    built = build("encoder", config, input_shape=(1,))
    assert (built.width, built.frame.side, built.frame.label) == (2, 75, "mine")
    assert isinstance(built.frame.inner, Toy)  # a part within a value
    with pytest.raises(ConfigError, match=r"encoder\.side = 4"):
        resolve("encoder", {"name": "framed", "side": 4})
    with pytest.raises(ConfigError, match=r"encoder\.frame: unknown key"):
        resolve("encoder", {"name": "framed", "frame": {"side": 80}})


def test_a_constructor_that_asks_for_the_unknown_is_told_what_there_is() -> None:
    with pytest.raises(ConfigError, match=r"asks the framework for `moon`.*may ask for: input_shape"):
        build("encoder", {"name": "demanding"}, input_shape=(1,))


plain = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3),
    max_leaves=8,
)


@settings(deadline=None, max_examples=100)
@given(plain, st.lists(st.sampled_from(["list", "dict"]), max_size=4))
def test_a_target_key_is_found_however_deep(value: Any, path: list[str]) -> None:
    forbid_targets(value)  # hypothesis never draws the key itself
    hidden: Any = {"_target_": "os.system", "value": value}
    for step in path:
        hidden = [value, hidden] if step == "list" else {"a": value, "b": hidden}
    with pytest.raises(ConfigError, match="must not be able to run code"):
        forbid_targets(hidden)
