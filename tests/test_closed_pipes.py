"""Commands whose output is no longer read (`| head -1`): they continue and end without an error message."""

import io
import os
import runpy
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.storage import commands
from framework.storage.commands import run_command

ROOT = Path(__file__).parents[1]
OF_OUR_OWN = {
    "framework/sweeps/fork_server.py",
    "framework/sweeps/ray_guard.py",
    "framework/sweeps/rehearsal.py",
    "framework/tracking/store_process.py",
    "framework/tracking/watch.py",
}
"""Processes that communicate with the framework by pipes, and that must end when their pipe is closed."""


EXPORTED = {
    "framework/deployment/exported_folder/predict.py",
    "framework/deployment/exported_folder/serve.py",
}
"""Scripts of an exported folder, which are copied there and run without the framework (test_export.py)."""
GENERATORS = {"plugins/density_head/von_mises/fit_coefficients.py"}
"""Programs that write one file of the source and print nothing."""


def programs() -> set[str]:
    """Files of the framework and its plugins that can be run as scripts."""
    files = [
        file for room in ("framework", "plugins", "hydra_plugins") for file in (ROOT / room).rglob("*.py")
    ]
    run = [file for file in files if 'if __name__ == "__main__":' in file.read_text(encoding="utf-8")]
    return {str(file.relative_to(ROOT)) for file in run}


PROGRAMS = sorted(programs() - OF_OUR_OWN - GENERATORS - EXPORTED)


@contextmanager
def closed_output(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """A standard output whose reader has ended, as the interpreter makes one of a pipe; flushed as at its exit."""
    reads, writes = os.pipe()
    os.close(reads)
    stream = io.TextIOWrapper(io.BufferedWriter(io.FileIO(writes, "wb")), encoding="utf-8")
    monkeypatch.setattr(sys, "stdout", stream)
    try:
        yield
        sys.stdout.flush()
    finally:
        sys.stdout.detach()  # what took its place
        with suppress(BrokenPipeError, ValueError):
            stream.close()
        monkeypatch.undo()


def test_the_programs_are_found() -> None:
    assert programs() >= OF_OUR_OWN | GENERATORS
    assert {"framework/__main__.py", "plugins/data/registration/__main__.py"} <= {*PROGRAMS} and len(
        PROGRAMS
    ) >= 7


@pytest.mark.parametrize("program", PROGRAMS)
def test_a_command_whose_reader_has_ended_ends_as_usual(
    program: str, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", [program, "--help"])
    for name in ("HYDRA_FULL_ERROR", "GOMP_SPINCOUNT"):  # which are put back afterwards
        monkeypatch.setenv(name, "0")
    code: object = None
    with closed_output(monkeypatch):
        try:
            runpy.run_path(str(ROOT / program), run_name="__main__")
        except SystemExit as ended:
            code = ended.code
    assert code in (0, None)
    assert not capfd.readouterr().err


def test_a_picture_is_drawn_though_nobody_reads_its_name(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    scene, picture = tmp_path / "triangle.off", tmp_path / "triangle.png"
    scene.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    words = [str(scene), "--size", "16x12", "--supersampling", "1", "--out", str(picture)]
    monkeypatch.setattr(sys, "argv", ["rasterizer", *words])
    with closed_output(monkeypatch):
        runpy.run_path(str(ROOT / "plugins/renderer/rasterizer/__main__.py"), run_name="__main__")
    assert picture.is_file()


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (DataError("it is bad"), "error: it is bad"),
        (KeyboardInterrupt(), 130),
        (OSError(28, "No space left on device", "a.png"), "a.png"),
    ],
)
def test_what_goes_wrong_in_a_command_is_a_sentence(
    error: BaseException, code: object, monkeypatch: pytest.MonkeyPatch
) -> None:
    def main(arguments: list[str]) -> None:
        raise error

    monkeypatch.setattr(commands, "survive_closed_pipes", lambda: None)
    with pytest.raises(SystemExit) as ended:
        run_command(main)
    assert ended.value.code == code or str(code) in str(ended.value.code)
