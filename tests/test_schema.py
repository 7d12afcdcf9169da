"""Checks of configs against the signatures of constructors, with one message for every fault."""

import importlib
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import date, timedelta
from decimal import Decimal
from enum import Enum, IntEnum
from pathlib import Path
from typing import Annotated, Any, Dict, List, Literal, NamedTuple, Optional, Tuple, Union  # noqa: UP035
from uuid import UUID

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import AfterValidator, BaseModel, Field
from typing_extensions import TypedDict

import framework.configuration.schema as schema
from framework.configuration.registry import GROUPS, installed
from framework.configuration.registry import load as load_installed
from framework.configuration.schema import build, forbid_targets, resolve
from framework.configuration.settings import device_of
from framework.configuration.signature import untyped
from framework.encoder import Encoder
from framework.errors import ConfigError
from framework.storage import checkpoints


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
    """Value whose fields are keys of the config."""

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
    """Class with a framework parameter that does not exist."""

    def __init__(self, moon: str) -> None:
        super().__init__((1,))


class Choosy(Toy):
    """Checks by itself, or leaves it to torch."""

    def __init__(self, input_shape: tuple[int, ...], *, width: int = 3, by_torch: bool = False) -> None:
        super().__init__(input_shape, width=width)
        if by_torch:
            torch.nn.Conv2d(3, 4, 1, groups=width)
        elif width % 2:
            raise ValueError(f"width must be even,\nnot {width}")


class Named(Toy):
    """Class whose parts have names that no config can set."""

    def __init__(
        self, input_shape: tuple[int, ...], *, experts: dict[str, list[Encoder]] | None = None
    ) -> None:
        super().__init__(input_shape)


CLASSES: dict[str, type] = {
    "toy": Toy,
    "demanding": Demanding,
    "framed": Framed,
    "choosy": Choosy,
    "named": Named,
}


@pytest.fixture(autouse=True)
def toys(monkeypatch: pytest.MonkeyPatch) -> dict[str, type]:
    """Return the installed classes by name, to which a test can add further ones."""
    classes = dict(CLASSES)

    def load(group: str, name: str) -> type:
        if name not in classes:
            raise ConfigError(f"No {group} is called {name!r}.")
        return classes[name]

    monkeypatch.setattr(schema, "load", load)
    return classes


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
        (7, "expected the name of a plugin of the group encoder"),
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
    with pytest.raises(ConfigError, match=r"the parameter `moon`.*the framework supplies input_shape\."):
        build("encoder", {"name": "demanding"}, input_shape=(1,))


NOTHING = object()


def taking(annotation: Any, default: Any = NOTHING, key: str = "value") -> type[Toy]:
    """A class with one parameter, which its instances hold as `taken`."""

    class Taking(Toy):
        def __init__(self, input_shape: tuple[int, ...], **given: Any) -> None:
            super().__init__(input_shape)
            self.taken = given[key]

    called = "" if default is NOTHING else " = default"
    scope: dict[str, Any] = {"default": default, "annotation": annotation, "whole": Taking.__init__}
    exec(
        f"def __init__(self, input_shape, *, {key}: annotation{called}): whole(self, input_shape, {key}={key})",
        scope,
    )
    Taking.__init__ = scope["__init__"]
    return Taking


class Color(Enum):
    RED = "red"
    BLUE = "blue"


class Level(IntEnum):
    LOW = 1
    HIGH = 2


class Corner(NamedTuple):
    x: int
    y: float = 0.5


class Inner(BaseModel):
    a: int = 1
    where: Path = Path("/tmp")


class Renamed(BaseModel):
    a: int = Field(1, alias="first")


@dataclass(frozen=True, kw_only=True)
class Value:
    x: int = 1
    color: Color = Color.RED


@dataclass
class Positional:
    x: int
    more: list[int] = field(default_factory=list)


class Table(TypedDict):
    x: int
    where: Path


KINDS: dict[str, tuple[Any, Any, Any]] = {
    "int": (int, 3, 3),
    "float": (float, -0.0, -0.0),
    "not a number": (float, math.nan, math.nan),
    "complex": (complex, 2j, 2j),
    "bool": (bool, True, True),
    "text": (str, "", ""),
    "literal": (Literal["a", 3], "a", "a"),
    "constraint": (Annotated[int, Field(gt=0)], 1, 1),
    "path": (Path, Path("/tmp/x"), "/tmp/x"),
    "enum": (Color, Color.BLUE, "blue"),
    "enum of numbers": (Level, Level.HIGH, 2),
    "model": (Inner, Inner(a=2, where=Path("/x")), {"a": 2, "where": "/x"}),
    "model with aliases": (Renamed, Renamed(first=4), {"first": 4}),
    "value": (Value, Value(x=4, color=Color.BLUE), {"x": 4, "color": "blue"}),
    "positional": (Positional, Positional(1, [2]), {"x": 1, "more": [2]}),
    "named tuple": (Corner, Corner(1, 2.0), (1, 2.0)),
    "typed dict": (Table, {"x": 1, "where": Path("/x")}, {"x": 1, "where": "/x"}),
    "date": (date, date(2020, 1, 31), "2020-01-31"),
    "duration": (timedelta, timedelta(seconds=90), "PT1M30S"),
    "decimal": (Decimal, Decimal("0.10"), "0.10"),
    "identifier": (UUID, UUID(int=7), str(UUID(int=7))),
    "set": (set[int], {3, 1, 2}, {1, 2, 3}),
    "bare list": (List, [1, "a"], [1, "a"]),  # noqa: UP006
    "bare tuple": (Tuple, (1, "a"), (1, "a")),  # noqa: UP006
    "bare dict": (Dict, {"q": [1]}, {"q": [1]}),  # noqa: UP006
    "anything": (Any, {"a": [1]}, {"a": [1]}),
}
"""Annotations, each with a value and with the form of this value in a config and a checkpoint."""
WRAPS: dict[str, tuple[Callable[[Any], Any], Callable[[Any], Any]]] = {
    "itself": (lambda kind: kind, lambda one: one),
    "optional": (lambda kind: Optional[kind], lambda one: one),  # noqa: UP045
    "or none": (lambda kind: Union[kind, None], lambda one: one),  # noqa: UP007
    "annotated": (lambda kind: Annotated[kind, Field(description="told")], lambda one: one),
    "list": (lambda kind: list[kind], lambda one: [one, one]),
    "tuple": (lambda kind: tuple[kind, ...], lambda one: (one, one)),
    "sequence": (lambda kind: Sequence[kind], lambda one: [one]),
    "dict": (lambda kind: dict[str, kind], lambda one: {"a": one}),
    "mapping": (lambda kind: Mapping[str, kind], lambda one: {"a": one}),
    "list of lists": (lambda kind: list[list[kind]], lambda one: [[one], []]),
}


def alike(found: Any, wanted: Any) -> bool:
    """Return whether two values are equal and have the same type; NaN equals NaN."""
    return type(found) is type(wanted) and (found == wanted or repr(found) == repr(wanted))


@pytest.mark.parametrize(
    "kind, wrap",
    # a value by itself has no key of its own, but one for each field
    [(kind, wrap) for kind in KINDS for wrap in WRAPS if (kind, wrap) != ("value", "itself")],
)
def test_a_parameter_arrives_as_it_is_annotated_and_is_kept_as_plain_values(
    kind: str, wrap: str, toys: dict[str, type], tmp_path: Path
) -> None:
    (annotation, value, plain), (around, several) = KINDS[kind], WRAPS[wrap]
    toys["by default"] = taking(around(annotation), several(value))
    toys["by config"] = taking(around(annotation))
    for config in ({"name": "by default"}, {"name": "by config", "value": several(plain)}):
        resolved = resolve("encoder", config)
        assert alike(resolved["value"], several(plain))
        assert alike(resolve("encoder", resolved), resolved)
        assert alike(build("encoder", resolved, input_shape=(1,)).taken, several(value))
    checkpoints.write({"value": several(plain)}, tmp_path / "one.ckpt")
    assert alike(checkpoints.read(tmp_path / "one.ckpt"), {"value": several(plain)})


@pytest.mark.parametrize(
    "annotation", [list, Any, list[Any], dict[str, Any], list[list[int]], Inner, Positional]
)
def test_no_build_shares_an_object_with_another(annotation: Any, toys: dict[str, type]) -> None:
    """Nor with the default or the config: whoever changes what he was given changes nobody else's."""
    default: Any = {dict[str, Any]: {"a": [1]}, Inner: Inner(), Positional: Positional(1)}.get(
        annotation, [[1], [2]]
    )
    toys["own"] = taking(annotation, default)
    resolved = resolve("encoder", "own")
    one, other = (build("encoder", resolved, input_shape=(1,)).taken for _ in range(2))
    before = repr(default), repr(resolved)
    (vars(one) if hasattr(one, "__dict__") else one).clear()
    assert (repr(default), repr(resolved)) == before and repr(other) == before[0]
    assert repr(build("encoder", resolve("encoder", "own"), input_shape=(1,)).taken) == before[0]


def test_what_is_lazy_or_frozen_arrives_whole(toys: dict[str, type], tmp_path: Path) -> None:
    toys["lazy"], toys["frozen"] = taking(Iterable[int], (1, 2)), taking(frozenset[int], frozenset({1, 2}))
    for name, wanted in {"lazy": [1, 2], "frozen": frozenset({1, 2})}.items():
        resolved = resolve("encoder", name)
        checkpoints.write({"part": resolved}, tmp_path / "one.ckpt")
        assert build("encoder", resolved, input_shape=(1,)).taken == wanted
        assert resolve("encoder", resolved) == resolved


def a_function() -> None:
    """Value that no checkpoint can store."""


@pytest.mark.parametrize(
    "annotation, default, message",
    [
        (
            Callable[[], None],
            a_function,
            r"encoder\.value = .*the value contains a function, which a checkpoint cannot store",
        ),
        (torch.dtype, torch.float32, "contains a dtype, which a checkpoint cannot store"),
        (Any, [{"a": torch.zeros(2)}], "contains a Tensor, which a checkpoint cannot store"),
        (
            Annotated[float, AfterValidator(math.radians)],
            180.0,
            "the annotation changes the value each time.*Let the constructor of Taking",
        ),
        (
            Annotated[Path, Field(strict=True)],
            Path("/x"),
            r"encoder\.value = '/x': .*stores this setting as a plain value .* which the annotation in Taking does",
        ),
        (Annotated[int, Field(gt=0)], 0, r"encoder\.value = 0: Input should be greater than 0"),
        (int, None, r"encoder\.value = None: Input should be a valid integer"),
        ([int], [1], r"annotation of `value`, \[<class 'int'>\], cannot be (checked|evaluated)"),
        ("Unknown", None, "annotation of `value`, Unknown, cannot be evaluated: NameError"),
        ("list[", None, "cannot be evaluated: SyntaxError"),
    ],
)
def test_what_cannot_be_kept_is_refused_before_anything_is_trained(
    annotation: Any, default: Any, message: str, toys: dict[str, type]
) -> None:
    toys["odd"] = taking(annotation, default)
    with pytest.raises(ConfigError, match=message):
        resolve("encoder", "odd")


@pytest.mark.parametrize("around", ["itself", "list", "dict", "optional"])
@pytest.mark.parametrize("kind", [Inner, Positional, Value])
def test_a_misspelt_key_within_a_parameter_is_named(kind: type, around: str, toys: dict[str, type]) -> None:
    wrap, several = WRAPS[around]
    toys["odd"] = taking(wrap(Optional[kind]))  # noqa: UP045
    wrong = {Inner: "wher", Positional: "moer", Value: "colr"}[kind]
    given = {"wher": 1} if kind is Inner else {"x": 1, wrong: 2}
    with pytest.raises(ConfigError, match=rf"encoder\.value\..*{wrong}: unknown key\. Did you mean"):
        resolve("encoder", {"name": "odd", "value": several(given)})


@pytest.mark.parametrize(
    "key", ["schema", "copy", "json", "model_config", "model_fields", "_scale", "__x", "dict", "value"]
)
def test_a_key_may_have_any_name(key: str, toys: dict[str, type], recwarn: pytest.WarningsRecorder) -> None:
    toys["odd"] = taking(float, 3, key)
    assert resolve("encoder", "odd") == {"name": "odd", key: 3.0}
    assert build("encoder", resolve("encoder", {"name": "odd", key: "4"}), input_shape=(1,)).taken == 4.0
    with pytest.raises(ConfigError, match=rf"encoder\.{key} = 'a': .*number"):
        resolve("encoder", {"name": "odd", key: "a"})
    assert not recwarn.list


def test_a_parameter_without_an_annotation_is_compared_with_its_default(toys: dict[str, type]) -> None:
    class Bare(Toy):
        def __init__(self, input_shape, *, rate=0.5, steps=3, quick=False, word="a", free=None):
            Encoder.__init__(self)
            self.input_shape, self.output_shape = input_shape, (1,)

    toys["bare"] = Bare
    assert untyped(Bare) == ["rate", "steps", "quick", "word", "free"] and untyped(Toy) == []
    good = {"rate": 1, "steps": 0.5, "quick": True, "word": "b", "free": [1]}
    assert resolve("encoder", {"name": "bare", **good}) == {"name": "bare", **good}
    for key, value in {"rate": "0,1", "steps": [3], "quick": "maybe", "word": 3}.items():
        with pytest.raises(ConfigError, match=rf"encoder\.{key} = "):
            resolve("encoder", {"name": "bare", key: value})


def test_a_part_may_be_annotated_in_many_ways(toys: dict[str, type]) -> None:
    one = {
        "plain": Encoder,
        "optional": Optional[Encoder],  # noqa: UP045
        "annotated": Annotated[Encoder, Field(description="told")],
    }
    several = {"list": list[Encoder], "tuple": tuple[Encoder, ...], "sequence": Sequence[Encoder] | None}
    for name, annotation in (one | several).items():
        toys[name] = taking(annotation)
        config = {"name": name, "value": "toy" if name in one else ["toy", {"name": "toy", "width": 3}]}
        taken = build("encoder", resolve("encoder", config), input_shape=(2,)).taken
        if name in one:
            assert isinstance(taken, Toy)
        else:
            assert [part.width for part in taken] == [8, 3]
            assert type(taken) is (tuple if name == "tuple" else list)
    assert (
        build("encoder", resolve("encoder", {"name": "optional", "value": None}), input_shape=(2,)).taken
        is None
    )


MODULE = """
from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from framework.encoder import Encoder

if TYPE_CHECKING:
    from framework.target import Target


class Later(Encoder):
    bibtex = ""

    def __init__(self, target: Target, /, input_shape: NoSuch, *, widths: list[int] = [1], inner: Encoder = None):
        super().__init__()
        self.target, self.input_shape, self.taken, self.inner = target, input_shape, widths, inner

    def forward(self, inputs: Target) -> Target:
        return inputs


@dataclass(frozen=True, kw_only=True)
class Outside:
    side: Annotated[int, Field(gt=0)] = 4
    more: list[Inside] = field(default_factory=list)


@dataclass(frozen=True)
class Inside:
    x: int


class Unread(Later):
    def __init__(self, target: Target, input_shape: NoSuch, *, aim: Target | None = None):
        super().__init__(target, input_shape)
"""


def test_annotations_of_what_the_framework_gives_are_never_evaluated(
    toys: dict[str, type], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "written_later.py").write_text(MODULE, encoding="utf-8")
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("written_later")
    toys["later"], toys["unread"] = module.Later, module.Unread
    built = build("encoder", resolve("encoder", "later"), target="given", input_shape=(1,))
    assert (built.target, built.input_shape, built.taken) == ("given", (1,), [1])
    with pytest.raises(ConfigError, match=r"encoder\.widths\.0 = 'a'"):
        resolve("encoder", {"name": "later", "widths": ["a"]})
    with pytest.raises(ConfigError, match=r"Unread: the annotation of `aim`, .*Target.*TYPE_CHECKING"):
        resolve("encoder", "unread")

    @dataclass(frozen=True, kw_only=True)
    class Here(module.Outside):
        """Its base's annotations are names of the base's module."""

        own: int = 2

    toys["here"] = taking(Here)
    assert resolve("encoder", "here") == {"name": "here", "side": 4, "more": [], "own": 2}
    built = build("encoder", resolve("encoder", {"name": "here", "more": [{"x": 1}]}), input_shape=(1,))
    assert built.taken == Here(more=[module.Inside(1)])


@dataclass(frozen=True, kw_only=True)
class Nested:
    """A value within a value, and an object made anew for each."""

    frame: Frame = Frame(side=20, label="inner")
    notes: list[str] = field(default_factory=lambda: ["a"])


@dataclass(frozen=True, kw_only=True)
class Clash:
    width: int = 1


@dataclass(frozen=True, kw_only=True)
class Called:
    name: str = "x"


def test_values_hold_values(toys: dict[str, type]) -> None:
    toys["usual"] = taking(Nested)
    toys["given"] = taking(Nested, Nested(frame=Frame(side=30, label="given"), notes=["b"]))
    assert resolve("encoder", "usual") == {
        "name": "usual", "side": 20, "label": "inner", "inner": None, "notes": ["a"],
    }  # fmt: skip
    built = [build("encoder", resolve("encoder", "given"), input_shape=(1,)).taken for _ in range(2)]
    assert built[0] == built[1] == Nested(frame=Frame(side=30, label="given"), notes=["b"])
    assert built[0].notes is not built[1].notes
    config = resolve("encoder", {"name": "usual", "side": 9, "inner": "toy"})
    assert build("encoder", config, input_shape=(1,)).taken.frame.side == 9


class TwoValues(Toy):
    def __init__(self, input_shape: tuple[int, ...], *, one: Frame, two: Nested) -> None:
        super().__init__(input_shape)


class ValueAndKey(Toy):
    def __init__(self, input_shape: tuple[int, ...], *, one: Clash, width: int = 2) -> None:
        super().__init__(input_shape)


class KeyAndValue(Toy):
    def __init__(self, input_shape: tuple[int, ...], *, width: int = 2, one: Clash = Clash()) -> None:
        super().__init__(input_shape)


class NamedItself(Toy):
    def __init__(self, input_shape: tuple[int, ...], *, name: str = "toy") -> None:
        super().__init__(input_shape)


class NamedByValue(Toy):
    def __init__(self, input_shape: tuple[int, ...], *, one: Called = Called()) -> None:
        super().__init__(input_shape)


@pytest.mark.parametrize(
    "cls, message",
    [
        (TwoValues, "TwoValues has the key 'side' twice, as a field of `one` and as a field of `two`"),
        (ValueAndKey, "'width' twice, as a field of `one` and as the parameter `width`"),
        (KeyAndValue, "'width' twice, as the parameter `width` and as a field of `one`"),
        (NamedItself, "'name' twice, as the name of the plugin and as the parameter `name`.*Rename"),
        (NamedByValue, "'name' twice, as the name of the plugin and as a field of `one`"),
    ],
)
def test_a_key_that_stands_twice_is_named(cls: type, message: str, toys: dict[str, type]) -> None:
    toys["twice"] = cls
    for config in ("twice", {"name": "twice", "side": 9, "width": 1}):
        with pytest.raises(ConfigError, match=message):
            resolve("encoder", config)


def test_a_loaded_model_is_built_with_none_for_what_only_training_needs(toys: dict[str, type]) -> None:
    toys["initial"] = taking(Path)
    resolved = resolve("encoder", {"name": "initial", "value": "/weights"})
    assert build("encoder", {**resolved, "value": None}, input_shape=(1,)).taken is None


@pytest.mark.parametrize("group", GROUPS)
def test_every_installed_plugin_is_kept_as_it_is_read(group: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(schema, "load", load_installed)
    for name in installed(group):
        try:
            resolved = resolve(group, name)
        except ConfigError as error:
            assert "is missing: Field required" in str(error), error
        else:
            assert alike(resolve(group, resolved), resolved), name


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


@pytest.mark.parametrize("config", [{}, {"width": 5}, {"width": 2, "by_torch": True}])
@pytest.mark.parametrize("inner", [False, True])
def test_a_constructor_may_refuse_by_a_value_error(config: dict[str, Any], inner: bool) -> None:
    chosen = {"name": "choosy", **config}
    resolved = resolve("encoder", {"name": "toy", "inner": chosen} if inner else chosen)
    said = (
        "must be divisible by groups"
        if "by_torch" in config
        else f"width must be even, not {config.get('width', 3)}"
    )
    with pytest.raises(ConfigError) as caught:
        build("encoder", resolved, input_shape=(1,))
    told = str(caught.value)
    assert said in told
    assert "encoder choosy refuses width=" in told
    (line,) = re.findall(rf"\(ValueError at {re.escape(__file__)}:(\d+)\)", told)
    source = Path(__file__).read_text(encoding="utf-8").splitlines()[int(line) - 1]
    assert "Conv2d" in source or "raise ValueError" in source
    assert told.startswith("encoder toy cannot be built, because its part `inner` cannot be built: ") == inner


def test_plugins_that_no_config_can_name_are_refused() -> None:
    with pytest.raises(
        ConfigError,
        match=r"Named: the annotation of `experts`, dict.* of the group encoder .*a list or a tuple",
    ):
        resolve("encoder", "named")


@pytest.mark.parametrize("there", [True, False])
@pytest.mark.parametrize("accelerator", [None, "auto", "cpu", "gpu", "cuda", "mps", "tpu"])
def test_a_stored_model_is_tested_on_the_device_that_the_user_chose(
    accelerator: str | None, there: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: there)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    if accelerator in ("mps", "tpu") or (accelerator in ("gpu", "cuda") and not there):
        with pytest.raises(ConfigError, match=f"'{accelerator}'.*Choose"):
            device_of(accelerator)
    else:
        assert device_of(accelerator).type == ("cuda" if there and accelerator != "cpu" else "cpu")
