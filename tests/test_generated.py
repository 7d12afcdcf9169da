"""Generated data in the cache (framework.storage.generated), which are complete or absent, and generated only once."""

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from framework.errors import DataError
from framework.storage import generated
from framework.storage.cache import folder
from framework.storage.generated import MARK, draw_all, read_mark


@pytest.fixture
def cache(tmp_path: Path) -> Path:
    return tmp_path


def write(root: Path) -> None:
    (root / "content").write_text("whole", encoding="utf-8")


def test_it_is_written_once_and_marked(cache: Path) -> None:
    root = generated.ensure_generated(cache / "things" / "seed0", {"seed": 0}, write)
    assert root == cache / "things" / "seed0"
    assert (root / "content").read_text(encoding="utf-8") == "whole"
    assert read_mark(root) == {"seed": 0}
    assert read_mark(cache) is None

    def again(root: Path) -> None:
        raise AssertionError("it is there")

    assert generated.ensure_generated(cache / "things" / "seed0", {"seed": 0}, again) == root


def test_interrupted_writing_leaves_nothing_and_is_done_again(cache: Path) -> None:
    def interrupted(root: Path) -> None:
        write(root)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        generated.ensure_generated(cache / "things" / "a", {}, interrupted)
    assert [path.name for path in cache.rglob("*") if path.is_file()] == [".a.lock"]
    left = cache / "things" / ".a.part"  # what a killed process would leave
    left.mkdir()
    (left / "half").write_bytes(b"")
    root = generated.ensure_generated(cache / "things" / "a", {}, write)
    assert sorted(path.name for path in root.iterdir()) == ["content", MARK]
    assert not left.exists()


def test_two_at_once_write_it_once(cache: Path) -> None:
    written: list[Path] = []
    both_wait = threading.Barrier(2)

    def counted(root: Path) -> None:
        written.append(root)
        write(root)

    def ask() -> None:
        both_wait.wait()
        generated.ensure_generated(cache / "things" / "b", {}, counted)

    askers = [threading.Thread(target=ask) for _ in range(2)]
    for asker in askers:
        asker.start()
    for asker in askers:
        asker.join()
    assert len(written) == 1


def test_a_changed_mark_is_refused(cache: Path) -> None:
    root = generated.ensure_generated(cache / "things" / "c", {"seed": 1}, write)
    (root / MARK).write_text(json.dumps({"seed": 2}), encoding="utf-8")
    with pytest.raises(
        DataError, match=r"does not describe \{'seed': 1\}, so this file was changed\. Delete"
    ):
        generated.ensure_generated(cache / "things" / "c", {"seed": 1}, write)
    (root / MARK).write_text("{", encoding="utf-8")
    with pytest.raises(DataError, match=r"synthetic\.json: cannot be read .* Delete"):
        generated.ensure_generated(cache / "things" / "c", {"seed": 1}, write)
    (root / MARK).unlink()
    with pytest.raises(DataError, match="does not describe"):
        generated.ensure_generated(cache / "things" / "c", {"seed": 1}, write)


def test_a_cache_that_cannot_be_written_is_said(cache: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (cache / "file").write_bytes(b"")
    with pytest.raises(DataError, match=r"cannot be written to .*file.d .* set FRAMEWORK_CACHE"):
        generated.ensure_generated(cache / "file" / "d", {}, write)
    monkeypatch.setenv("FRAMEWORK_CACHE", str(cache / "file"))
    with pytest.raises(DataError, match=r"cannot be created .* Set FRAMEWORK_CACHE to another folder"):
        folder("things")


def test_everything_is_drawn_and_a_fault_is_passed_on() -> None:
    drawn: list[int] = []
    draw_all(50, drawn.append, "numbers")
    assert sorted(drawn) == list(range(50))

    def until_ten(number: int) -> None:
        if number == 10:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        draw_all(50, until_ten, "numbers")


PROCESSES = """
import os, signal, sys, threading
from framework.errors import DataError
from framework.storage import generated

generated._may_fork = lambda: True  # also on a machine with one core

def draw(number):
    if sys.argv[1] == "raises" and number == 8:  # of the other process
        raise DataError("number eight")
    if sys.argv[1] == "is killed" and os.getpid() != parent:
        os.kill(os.getpid(), signal.SIGKILL)
    if sys.argv[1] == "parent is killed" and os.getpid() == parent and number == 3:
        os.kill(parent, signal.SIGKILL)
    if sys.argv[1] == "parent is killed" and os.getpid() != parent:
        threading.Event().wait(0.05)
        print(number, flush=True)
    return number, os.getpid()

parent = os.getpid()
count = 300
try:
    results = generated.draw_all(count, draw, "numbers", in_processes=True)
except DataError as error:
    print(error)
else:
    print([number for number, _ in results] == list(range(count)), len({process for _, process in results}))
"""


def drawn_by(case: str) -> str:
    """Return the output of a process that draws 300 numbers in processes."""
    command = [sys.executable, "-c", PROCESSES, case]
    return subprocess.run(command, stdout=subprocess.PIPE, text=True, timeout=60).stdout


def test_processes_return_all_results_in_order() -> None:
    assert drawn_by("works") == "True 2\n"


@pytest.mark.parametrize(
    ("case", "message"),
    [
        ("raises", "number eight\n"),
        (
            "is killed",
            "A process that was drawing numbers has ended early, perhaps because memory is short. Repeat",
        ),
    ],
)
def test_a_failure_in_another_process_is_raised(case: str, message: str) -> None:
    assert drawn_by(case).startswith(message)


def test_a_process_ends_with_the_one_that_it_draws_for() -> None:
    """The output ends when both processes have ended; the rest of the numbers would take seven seconds."""
    assert len(drawn_by("parent is killed").splitlines()) < 20


def test_a_process_with_threads_is_not_forked() -> None:
    ready = threading.Event()
    thread = threading.Thread(target=ready.wait)
    thread.start()
    try:
        results = draw_all(200, lambda number: (number, os.getpid()), "numbers", in_processes=True)
    finally:
        ready.set()
        thread.join()
    assert results == [(number, os.getpid()) for number in range(200)]
