"""`trainer.profiler` writes its report into the run folder, and changes no number of the run."""

import pytest

from framework.configuration.command_line import _add_trainer_keys
from tests.conftest import TINY, Framework


def test_keys_of_lightning_need_no_plus_sign() -> None:
    given = [
        "trainer.profiler=simple",
        "trainer.max_epochs=3",
        "+trainer.benchmark=true",
        "trainer.maxepochs=3",
    ]
    assert _add_trainer_keys(given) == [f"++{given[0]}", *given[1:]]
    assert _add_trainer_keys(["seed=1"]) == ["seed=1"]


@pytest.mark.parametrize("profiler", ["simple", pytest.param("advanced", marks=pytest.mark.slow)])
def test_a_profile_is_in_the_run_folder_and_changes_no_number(framework: Framework, profiler: str) -> None:
    plain = framework(*TINY, "logger=none", folder="plain")
    profiled = framework(*TINY, "logger=none", f"trainer.profiler={profiler}", folder="profiled")
    assert profiled.code == 0, profiled.out
    text = (profiled.folder / "fit-profile.txt").read_text(encoding="utf-8")
    assert "run_training_batch" in text and "optimizer_step" in text
    assert f"{profiled.folder / 'fit-profile.txt'}" in profiled.out.replace("\n", "")
    assert profiled.losses() == plain.losses()
    assert not (plain.folder / "fit-profile.txt").exists()
