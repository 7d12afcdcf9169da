"""Readers of JSON and YAML refuse true, and texts that Python could convert, in place of a number."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from framework.configuration.schema import resolve
from framework.configuration.settings import Settings
from framework.datasets.scan_layout import read_cameras
from framework.errors import UserError
from framework.runs.job import RECORD, VALUE, read_record
from framework.scenes.gltf import read as read_gltf
from framework.scenes.turntable import read_camera
from framework.storage.plain_values import read_yaml
from framework.sweeps.jobs import Job
from framework.sweeps.results import read_results
from framework.tracking.journal import _record
from framework.tracking.run_info import SIDECAR, RunInfo, read_run_info

NO_NUMBERS = [True, "1_0", "nan", "0x10", " 1 ", "1", None, [], {}, 10**400]
"""Values that are not numbers, although Python or NumPy converts most of them to one."""
CAMERA = {"K": [[10.0, 0, 5], [0, 10, 5], [0, 0, 1]], "R": [[1, 0, 0], [0, 1, 0], [0, 0, 1]], "t": [0, 0, 2]}


def written(file: Path, content: Any) -> Path:
    """The file, with the content as JSON or YAML."""
    text = json.dumps(content) if file.suffix == ".json" else yaml.safe_dump(content)
    file.write_text(text, encoding="utf-8")
    return file


def camera(folder: Path, value: Any, suffix: str, key: str) -> Any:
    values: dict[str, Any] = {**CAMERA, "size": [8, 6]}
    values[key] = {"K": [[value, 0, 5], [0, 10, 5], [0, 0, 1]], "t": [0, 0, value], "size": [value, 6]}[key]
    return read_camera(written(folder / f"camera{suffix}", values))


def view(folder: Path, value: Any, key: str) -> Any:
    values: dict[str, Any] = {**CAMERA, "name": "a", "height": 6, "width": 8}
    values[key] = {"t": [0, 0, value], "height": value}[key]
    return read_cameras(written(folder / "cameras.json", {"views": [values]}))


def scene(folder: Path, value: Any, key: str) -> Any:
    """Read a scene of one triangle in which one number is replaced."""
    places: dict[str, dict[str, Any]] = {
        "scale": {"scale": [1, value, 1]},
        "rotation": {"rotation": [0, 0, 0, value]},
        "matrix": {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, value]},
        "mesh": {"mesh": 0 if value == 1 and value is not True else value},
    }
    material = {"pbrMetallicRoughness": {"baseColorFactor": [1, value if key == "color" else 1, 1, 1]}}
    primitive = {"attributes": {"POSITION": 0}, "material": 0}
    if key == "mode":
        primitive["mode"] = 4 if value == 1 and value is not True else value
    content = {
        "asset": {"version": "2.0"},
        "nodes": [{"mesh": 0, **places.get(key, {})}],
        "meshes": [{"primitives": [primitive]}],
        "materials": [material],
        "accessors": [{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}],
        "bufferViews": [{"buffer": 0, "byteLength": 36}],
        "buffers": [{"byteLength": 36, "uri": f"data:;base64,{TRIANGLE}"}],
    }
    return read_gltf(written(folder / "scene.gltf.json", content).rename(folder / "scene.gltf"))


TRIANGLE = "AAAAAAAAAAAAAAAAAACAPwAAAAAAAAAAAAAAAAAAgD8AAAAA"
"""The corners (0, 0, 0), (1, 0, 0) and (0, 1, 0), in base64."""


def run_info(folder: Path, value: Any, key: str) -> Any:
    known = RunInfo(None, "", "e", "r", None, None, "k", 1.0, "KILLED")
    written(folder / "run.json", {**vars(known), "owed": [], key: value}).rename(folder / SIDECAR)
    return read_run_info(folder)


def job(folder: Path, value: Any, key: str) -> Any:
    record = {"overrides": [], "command": [], "key": "a", "number": 1, "status": "ended", key: value}
    written(folder / "job.json", record).rename(folder / RECORD)
    return read_record(folder)


def left_value(folder: Path, value: Any) -> Any:
    written(folder / "value.json", value).rename(folder / VALUE)
    return Job(0, [], [], folder, "", "").value()


def results(folder: Path, value: Any, key: str) -> Any:
    """Read the results of a job in which `key` has `value`; unreadable results are left out with a warning."""
    found = {"method": "a", "data": "b", "columns": {"nll": "NLL"}, "better": {}, "nll": 1.0, "seed": 0}
    written(folder / "results.json", {**found, "device": "cpu", "threads": 1, key: value})
    read = read_results(folder)
    if not read:
        raise UserError("left out")
    return read


def journal(folder: Path, value: Any, key: str) -> Any:
    line: dict[str, Any] = {"n": 1, "time": 1.0, "step": 1, "epoch": 1, "values": {"loss": 1.0}}
    line |= {"values": {"loss": value}} if key == "values" else {key: value}
    found = _record(json.dumps(line).encode())
    if found is None:
        raise UserError("left out")
    return found


def setting(folder: Path, value: Any, key: str) -> Any:
    file = written(
        folder / "config.yaml", {key: value} if "." not in key else {"optimizer": {"factor": value}}
    )
    return Settings.of(read_yaml(file, "a config"))


def parameter(folder: Path, value: Any, key: str) -> Any:
    group, name, parameter = key.split()
    own = [value] if parameter == "widths" else value
    return resolve(
        group, read_yaml(written(folder / "part.yaml", {"name": name, parameter: own}), "a config")
    )


READERS: dict[str, Callable[[Path, Any], Any]] = {
    **{
        f"camera {suffix} {key}": lambda folder, value, suffix=suffix, key=key: camera(
            folder, value, suffix, key
        )
        for suffix in (".json", ".yaml")
        for key in ("K", "t", "size")
    },
    **{
        f"{read.__name__} {key}": lambda folder, value, read=read, key=key: read(folder, value, key)
        for read, keys in {
            view: ("t", "height"),
            scene: ("scale", "rotation", "matrix", "color", "mesh", "mode"),
            run_info: ("started", "sent"),
            job: ("number", "tries", "started"),
            results: ("nll", "seed", "threads"),
            journal: ("values", "step", "time", "n"),
            setting: ("seed", "batch_size", "optimizer.factor"),
            parameter: ("data moons noise", "data moons train", "encoder mlp widths", "encoder mlp dropout"),
        }.items()
        for key in keys
    },
    "value of a job": left_value,
}
TAKEN = {
    "job started": [None],
    "results nll": [None],
    "results seed": [None, "1_0", "nan", "0x10", " 1 ", "1"],
    "journal values": ["nan"],
    **{f"setting {key}": ["1"] for key in ("seed", "batch_size")},
    **{f"parameter {key}": ["1"] for key in ("data moons noise", "data moons train", "encoder mlp widths")},
    "parameter encoder mlp dropout": [[]],
}
"""Values that a reader takes all the same: missing numbers, a seed that is a text, a journal's own NaN, a list
where one may stand, and in configs plain digits, which a variable of the environment holds."""


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize("value", NO_NUMBERS, ids=lambda value: repr(value)[:9])
def test_what_is_no_number_is_refused(reader: str, value: Any, tmp_path: Path) -> None:
    if value in TAKEN.get(reader, []) and not isinstance(value, bool):
        READERS[reader](tmp_path, value)
        return
    with pytest.raises(UserError):
        READERS[reader](tmp_path, value)


@pytest.mark.parametrize("reader", READERS)
def test_a_number_is_read(reader: str, tmp_path: Path) -> None:
    number = 0.5 if reader in ("setting optimizer.factor", "parameter encoder mlp dropout") else 1
    READERS[reader](tmp_path, number)


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        *[(one, one) for one in ("1_0", "0x10", "010", "1:30", "1e3", "0b1", "1_0.5")],
        *[("12", 12), ("-3", -3), ("0", 0), ("1.5", 1.5), ("1.0e-05", 1e-5), (".inf", float("inf"))],
        *[("true", True), ("'12'", "12"), ("null", None)],
    ],
)
def test_numbers_of_yaml_are_those_that_programs_write(text: str, wanted: Any, tmp_path: Path) -> None:
    (tmp_path / "one.yaml").write_text(f"key: {text}\n")
    found = read_yaml(tmp_path / "one.yaml", "a value")["key"]
    assert found == wanted and type(found) is type(wanted)


@pytest.mark.parametrize(
    "value", [0, -7, 10**20, 1e-5, 1e300, -0.0, float("inf"), "1_0", "0x10", "1e-3", True, None]
)
def test_what_is_written_as_yaml_is_read_again(value: Any, tmp_path: Path) -> None:
    assert read_yaml(written(tmp_path / "one.yaml", [value]), "a value") == [value]
