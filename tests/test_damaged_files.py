"""Damaged and malicious files, which every reader reads or refuses with an error message, within limits of time."""

import ast
import os
import pickle
import struct
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.configuration.settings import Settings
from framework.datasets import images
from framework.datasets.images import Crop, cut_square
from framework.errors import ConfigError, DataError, quote, shorten
from framework.storage import reading
from framework.storage.plain_values import read_yaml, require_plain_pickle
from framework.storage.reading import inflate, translate_errors
from tests.fuzz.damaged_states import HEAVY

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
@pytest.mark.parametrize("count", [100])
def test_no_reader_crashes_hangs_or_raises_anything_but_a_sentence(count: int, tmp_path: Path) -> None:
    """Whole files, pipes, devices, folders, and crafted and damaged files, a tenth for the arrays of each plugin.

    Nor takes one of them more than 1 GiB, changes an array elsewhere, or has damage answer as if it were whole. Each
    module that guards a file is among the readers.
    """
    done = subprocess.run(
        [sys.executable, "-m", "tests.fuzz.fuzz", "--files", str(count), "--check"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stdout.splitlines() if " files, " in line]
    assert sum(f" {count} files, " in line for line in lines) >= 50
    assert all(" 0 unclean, 0 silent, 0 crashes, 0 hangs" in line for line in lines), done.stdout
    fuzzed = {line.partition(":")[0] for line in lines}
    storing = {name for group in ("density_head", "encoder", "uncertainty") for name in arrays_of(group)}
    assert storing - fuzzed <= NOT_DAMAGED
    require_every_reader({*done.stdout.rpartition("guards: ")[2].split()})


def arrays_of(group: str) -> list[str]:
    return [f"arrays of {group} {name}" for name in installed(group)]


NOT_DAMAGED = {"arrays of density_head lorentzian", *(f"arrays of encoder {name}" for name in HEAVY)}
"""Plugins that store no arrays, and those whose large weights are read by the same code as those of other networks."""


def require_every_reader(reached: set[str]) -> None:
    """Require that `reached` holds each module that guards a file, and that no other module opens files."""
    guarding, opening = set[str](), set[str]()
    for file in (path for top in ("framework", "plugins") for path in (ROOT / top).rglob("*.py")):
        name = file.relative_to(ROOT).as_posix()
        if (
            file.name.startswith("test_")
            or file.name == "rows.py"
            or name.startswith(("framework/testing/", "framework/storage/"))
        ):
            continue
        called = {
            ast.unparse(node.func)
            for node in ast.walk(ast.parse(file.read_text(encoding="utf-8")))
            if isinstance(node, ast.Call)
        }
        if {"translate_errors", "reading.translate_errors"} & called:
            guarding.add(name)
        if any(one in ("open", "np.load", "torch.load") or one.endswith(READING) for one in called):
            opening.add(name)
    assert guarding - reached == OWN_CACHE | OTHER_TEST.keys()
    assert opening == OWN_FILES.keys()


READING = (".read_text", ".read_bytes", "Image.open", ".loadmat")
OWN_CACHE = {
    "framework/bodies/default_body.py",
    "framework/bodies/topologies.py",
    "plugins/data/labelled_clouds/reading.py",
    "plugins/data/symmetric_solids/data.py",
}
"""Modules that guard files in the project's own cache; `read_npy` and `read_npz`, which are tested here, read them."""
OTHER_TEST = {
    "framework/runs/resuming.py": "test_callbacks.py::test_a_foreign_state_of_a_training_gets_a_sentence"
}
"""Modules that guard a file whose damages another test tries, and this test."""
OWN_FILES = {
    "framework/configuration/citations.py": "references.bib of this and of other installed packages",
    "framework/configuration/command_line.py": "the package's trainer/default.yaml",
    "framework/configuration/composition.py": "the package's config.yaml",
    "framework/datasets/images.py": "within a guard",
    "framework/deployment/export.py": "the package's scripts for exported folders",
    "framework/deployment/exported_folder/predict.py": "runs without this package; test_export.py damages its input",
    "framework/evaluation/cost.py": "/proc",
    "framework/modes/new.py": "the package's own examples",
    "framework/modes/plugins.py": "the package's own modules",
    "framework/runs/repository.py": "the copy of an index that it has made",
    "framework/scaffold/data/example.py": "an example for plugins; mode=check damages its files",
    "framework/sweeps/ray_guard.py": "/proc",
    "framework/tracking/watch.py": "/proc",
    "plugins/data/cest/data.py": "the cache, fitted again where it cannot be read",
    "plugins/density_head/von_mises/coefficients.py": "the package's table of coefficients",
}
"""Modules outside `framework.storage` that open files, and the files that they open."""


def test_a_strip_is_scaled_before_it_is_padded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The middle of the figure shows the strip; the rest shows its border, as for images that need little memory."""
    random = np.random.default_rng(0)
    smooth = np.kron(random.integers(0, 256, (1, 25, 3)), np.ones((12, 40, 1))).astype(np.uint8)  # 1000 x 12
    for pixels in (smooth, smooth.transpose(1, 0, 2)):
        picture = Image.fromarray(np.ascontiguousarray(pixels))
        box = (0.0, 0.0, float(picture.width), float(picture.height))
        wanted = cut_square(picture, box, 0.1, 16)
        with monkeypatch.context() as patched:
            patched.setattr(images, "MOST_PADDED", 400**2)
            found = cut_square(picture, box, 0.1, 16)
        assert wanted is not None and found is not None
        assert np.abs(found.astype(float) - wanted).max() <= 12
        assert np.abs(found.astype(float) - wanted).mean() <= 2
    long = tmp_path / "long.png"
    Image.fromarray(np.full((60_000, 3), 77, np.uint8)).save(long)
    assert (Crop(long, None, 0.0, 16).read() == 77).all()


@pytest.mark.parametrize("size", [(70_000, 2), (2, 70_000), (9_200, 9_200)])
def test_images_of_too_many_pixels_are_refused_before_they_are_decoded(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    Image.new("1", size).save(tmp_path / "one.png")
    with pytest.raises(DataError, match=r"one\.png: .*pixels; at most .* Scale the image down"):
        Crop(tmp_path / "one.png", None, 0.0, 16).check()


@pytest.mark.parametrize("kind", ["png", "bmp"])
def test_icons_are_read_and_their_large_images_refused(kind: str, tmp_path: Path) -> None:
    file = tmp_path / "one.ico"
    Image.new("RGB", (32, 32), (9, 99, 200)).save(file, bitmap_format=kind, sizes=[(16, 16), (32, 32)])
    pixels = Crop(file, None, 0.0, 16).read()
    assert (pixels == np.array([9, 99, 200]).reshape(3, 1, 1)).all()
    content = file.read_bytes()
    start = int.from_bytes(content[6 + 16 + 12 : 6 + 16 + 16], "little")
    sides = struct.pack(">II", 3000, 1400) if kind == "png" else struct.pack("<ii", 3000, -1400)
    place = start + (16 if kind == "png" else 4)
    file.write_bytes(content[:place] + sides + content[place + 8 :])
    with pytest.raises(DataError, match=r"one\.ico: .*the icon holds an image of 3000 x -?1400 pixels"):
        Crop(file, None, 0.0, 16).read()


def test_an_image_that_another_program_would_decode_is_refused(tmp_path: Path) -> None:
    Image.new("RGB", (9, 9)).save(tmp_path / "one.eps")
    (tmp_path / "one.eps").rename(tmp_path / "one.png")
    with pytest.raises(DataError, match=r"one\.png: cannot be read as an image"):
        Crop(tmp_path / "one.png", None, 0.0, 16).read()


def test_the_guard_turns_any_error_into_a_sentence_that_names_the_file(tmp_path: Path) -> None:
    file = tmp_path / "one.x"
    file.touch()
    for error in (
        ValueError("a\nb" * 999),
        NotImplementedError(),
        MemoryError("\x1b[2J"),
        RecursionError("r"),
        KeyError("k"),
    ):
        with (
            pytest.raises(DataError, match=r"one\.x: cannot be read as a thing \(.*\)\. Mend it\.") as caught,
            translate_errors(file, "a thing", "Mend it."),
        ):
            raise error
        assert len(str(caught.value)) < len(str(file)) + 260
        assert str(caught.value).isprintable()
    with pytest.raises(ConfigError, match=r"^.*one\.x: said$"), translate_errors(file, "a thing"):
        raise ConfigError("said")
    with pytest.raises(KeyboardInterrupt), translate_errors(file, "a thing"):
        raise KeyboardInterrupt
    gone = tmp_path / "gone.x"
    with (
        pytest.raises(DataError, match=r"gone\.x: no such file; expected a thing\. Correct the path\."),
        translate_errors(gone, "a thing"),
    ):
        reading.read_bytes(gone)


def test_damage_is_quoted_in_two_hundred_characters_that_steer_no_terminal() -> None:
    assert shorten("x" * 300) == "x" * 199 + "…"
    assert shorten("a\x1b[31m\ud800b") == "a\\x1b[31m\\ud800b"
    assert len(quote("\0" * 10**6)) == 200
    assert shorten("first\n  second") == "first second"


def test_inflating_stops_at_the_bound() -> None:
    import zlib

    packed = zlib.compress(bytes(1000))
    assert inflate(packed, 1000) == bytes(1000)
    assert inflate(packed, 10, part=True) == bytes(10)
    for content, most in ((packed, 999), (packed[:-5], 1000)):
        with pytest.raises(ValueError, match="cut short, or decompress"):
            inflate(content, most)


def test_stored_values_are_plain(tmp_path: Path) -> None:
    file = tmp_path / "config.yaml"
    for text in (
        "a: !!python/object/apply:os.system [id]",
        "a: !mine 1",
        "a: &a [1]\nb: *a",
        "[" * 100 + "]" * 100,
        "a: [",
    ):
        file.write_text(text)
        with pytest.raises(ConfigError, match=r"config\.yaml: cannot be read as a config"):
            read_yaml(file, "a config", "Start anew.", ConfigError)
    file.write_text("a: [1, {b: null}]\n")
    assert read_yaml(file, "a config") == {"a": [1, {"b": None}]}


def test_a_pickle_of_tuples_that_hold_the_same_tuple_twice_is_refused() -> None:
    """Hashing such a tuple of depth thirty takes minutes; a tuple as deep that repeats none is accepted."""
    nested: tuple = (1,)
    deep: tuple = (1,)
    for number in range(30):
        nested, deep = (nested, nested), (deep, number)
    for protocol in range(pickle.HIGHEST_PROTOCOL + 1):
        require_plain_pickle(
            pickle.dumps({"a": deep, "b": [(1, (2, 3))] * 9, "c": tuple(range(9999))}, protocol)
        )
        with pytest.raises(ValueError, match="contains a tuple of more than"):
            require_plain_pickle(pickle.dumps([nested], protocol))


@pytest.mark.parametrize(
    "key",
    ["callbacks", "logger", "plugins", "default_root_dir", "enable_checkpointing", "use_distributed_sampler"],
)
def test_what_the_framework_says_to_the_trainer_is_not_a_configs_to_say(key: str) -> None:
    with pytest.raises(ConfigError, match=rf"trainer\.{key}(: unknown key| = .*: there is no callback)"):
        Settings.of({"trainer": {key: ["x"]}})


NUMBERS_OF_COLUMNS = {name: [0.5, 2.0] for name in ("largest", "mean", "deviation")}
STATES = {
    "tabular": (
        {"columns": ["x", "y"], **NUMBERS_OF_COLUMNS},
        (
            None,
            "x",
            [],
            [1.0],
            [1.0, 2.0, 3.0],
            [[1.0, 2.0]],
            [1.0, float("nan")],
            [float("inf"), 1.0],
            {"x": 1.0},
        ),
    ),
    "human_scans": (
        {"height": 16, "width": 12},
        (None, "16", 0, -16, 16.0, float("nan"), 2**24, 10**400, [16], True),
    ),
}
"""States that data sets store with a model, and invalid values of these states."""


@pytest.mark.parametrize("name", STATES)
def test_what_data_keep_with_a_model_is_checked(name: str) -> None:
    state, wrong = STATES[name]
    data = build("data", resolve("data", name))
    data.load_state_dict(state)
    assert data.state_dict() == state
    for key in state:
        for value in wrong:
            with pytest.raises(DataError, match=rf"^The stored .* of {name} .*\."):
                data.load_state_dict({**state, key: value})
        with pytest.raises(DataError, match=f"^The stored .* of {name} "):
            data.load_state_dict({other: state[other] for other in state if other != key})
    for key in ("largest", "deviation"):
        for value in ([0.0, 1.0], [1.0, -1.0]):
            if key in state:
                with pytest.raises(DataError, match="The stored state of tabular"):
                    data.load_state_dict({**state, key: value})
    assert data.state_dict() == state


def test_no_more_of_a_file_is_read_than_it_has(tmp_path: Path) -> None:
    """A chunk that declares 64 TB is refused before that memory is allocated."""
    file = tmp_path / "one.x"
    file.write_bytes(b"abcdef")
    with reading.open_regular(file) as stream:
        assert [stream.read(2), stream.read(0), stream.read(2**46), stream.read(2**46), stream.read()] == [
            *(b"ab", b"", b"cdef", b"", b"")
        ]
        stream.seek(1)
        assert stream.read() == b"bcdef" and stream.seek(9) == 9 and stream.read(5) == b""
