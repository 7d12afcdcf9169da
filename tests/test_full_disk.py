"""Full disks and folders without permission: one error message, exit code 1, and complete checkpoints."""

import json
from pathlib import Path

import pytest

from framework.storage.checkpoints import read
from tests.conftest import TINY, Done, Framework, listed

STEPS = ("trainer.checkpoint_every_steps=2", "trainer.max_epochs=2", "optimizer=adam")


def one_sentence(done: Done) -> str:
    """Return the single error message of a command that failed, after checking that there is no traceback."""
    errors = [line for line in done.out.splitlines() if line.startswith("error: ")]
    assert done.code == 1, done.out
    assert len(errors) == 1, done.out
    assert "Traceback" not in done.out, done.out
    return errors[0]


@pytest.mark.parametrize(("size", "at"), [(4_000, "checkpoint"), (12_000, "last.ckpt"), (20_000, "")])
def test_a_disk_that_is_full_ends_a_run_with_a_sentence(size: int, at: str, framework: Framework) -> None:
    """No file longer than `size` bytes can be written, so the run fails during training, after it, or when it draws
    figures."""
    done = framework(*TINY, "pictures=true", f"+data.longest_file={size}", "logger=none", *STEPS)
    said = one_sentence(done)
    assert at in said, said
    assert "ree some space" in said, said
    for path in done.folder.rglob("*.ckpt"):
        read(path)
    for path in done.folder.rglob("*.json"):
        json.loads(path.read_text(encoding="utf-8"))


def test_a_disk_that_is_full_from_the_start(stranger_site: Path, tmp_path: Path) -> None:
    run = f"hydra.run.dir={tmp_path / 'run'}"
    arguments = (*TINY, "+data.longest_file=100", "logger=none", run)
    done = listed(*arguments, folder=tmp_path, site=stranger_site)
    assert "ree some space" in one_sentence(Done(done.code, done.out, tmp_path / "run"))


@pytest.mark.slow
def test_a_full_store_stops_nobody(framework: Framework, stranger_site: Path, tmp_path: Path) -> None:
    """No process can write a longer file; the run waits 5 s for the store when it closes, not a minute."""
    before = (
        "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (100_000, resource.RLIM_INFINITY))\n"
        "from framework.tracking.tracker import MlflowTracker as tracker\n"
        "tracker.__init__.__kwdefaults__['patience'] = 5.0\n"
    )
    arguments = (*TINY, *STEPS, f"hydra.run.dir={tmp_path / 'run'}")
    done = listed(*arguments, folder=tmp_path, site=stranger_site, before=before)
    assert done.code == 0, done.out
    assert "mode=sync" in done.out
    assert "Traceback" not in done.out
    sent = framework("mode=sync", f"mode.run={tmp_path / 'run'}", folder="sync")
    assert sent.code == 0, sent.out


@pytest.mark.parametrize("place", ["file", "file/run"])
def test_a_file_where_a_folder_is_wanted(place: str, framework: Framework, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    said = one_sentence(framework(*TINY, "logger=none", folder=place))
    assert "file" in said
    assert (tmp_path / "file").read_text() == "mine"
