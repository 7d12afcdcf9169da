"""Tests of mode=check: a correct plugin passes, and a faulty one fails with the place of its fault."""

import math
import re
from pathlib import Path

import pytest
import torch
from torch.distributions import MultivariateNormal

from framework.distributions.protocol import marginal
from framework.errors import ConfigError
from framework.modes import check
from framework.testing import contract as contracts
from framework.testing.finding import Finding, Worst, require, run_check
from plugins.density_head.gaussian.head import GaussianHead
from tests.conftest import Framework, listed
from tests.planted_heads import HEIGHT


def test_a_strangers_head_passes_by_name(framework: Framework) -> None:
    done = framework("mode=check", "density_head=wrapped_cauchy")
    assert done.code == 0, done.out
    assert "FAILS" not in done.out
    findings = (done.folder / "check.csv").read_text(encoding="utf-8").splitlines()
    assert len(findings) > 30
    assert sum("log_prob, float32" in line for line in findings) == 1  # only one row has a reference


@pytest.mark.slow
def test_torchs_von_mises_fails_and_the_table_says_where(stranger_site: Path, tmp_path: Path) -> None:
    # its sampler hangs at large concentrations, until the check's limit, which is 20 s
    sooner = (
        "from framework.testing import head_subject; check = head_subject.run_check\n"
        "head_subject.run_check = lambda *given, seconds: check(*given, seconds=min(seconds, 5.0))\n"
    )
    words = ("mode=check", "density_head=torch_von_mises", "threads=1", f"hydra.run.dir={tmp_path / 'run'}")
    done = listed(*words, folder=tmp_path, site=stranger_site, before=sooner)
    assert done.code == 1, done.out
    failed = {
        line.split("  ")[1].strip() for line in done.out.splitlines() if line.rstrip().endswith("FAILS")
    }
    expected = {
        "NaN and infinity refused",
        "finite for any raw parameters",
        "float32 against float64",
        "entropy",
    }
    assert expected <= failed
    findings = (tmp_path / "run" / "check.csv").read_text(encoding="utf-8")
    assert "finite for any raw parameters,TooSlow: the call did not end within 5 s" in findings
    assert "Traceback" not in done.out


def test_a_wrapper_that_mixes_densities_passes_and_one_that_averages_parameters_fails(
    framework: Framework,
) -> None:
    done = framework("mode=check", "uncertainty=[committee]")
    assert done.code == 0, done.out
    assert "one member equals the model" in done.out
    done = framework("mode=check", "uncertainty=[averaged_committee]")
    assert done.code == 1, done.out
    assert "averaged_committee: one member equals the model" in done.out


@pytest.mark.slow
def test_a_strangers_renderer_passes_by_name(framework: Framework) -> None:
    done = framework("mode=check", "renderer=ray_caster", "threads=1")
    assert done.code == 0, done.out
    findings = (done.folder / "check.csv").read_text(encoding="utf-8")
    for name in (
        "no holes",
        "sphere: depth",
        "faces cut by the near plane",
        "uv",
        "textures are drawn or refused",
    ):
        assert name in findings
    assert "FAILS" not in done.out


def test_a_strangers_data_set_passes_without_rows_as_far_as_one_can_say(framework: Framework) -> None:
    done = framework("mode=check", "data=dial")
    assert done.code == 0, done.out
    assert "no sample in two splits" in done.out
    assert "only a rows.py can state the expected result" in done.out
    done = framework("mode=check", "data=dial", "+data.bad_label=3")
    assert done.code == 1, done.out
    assert "dial: samples" in done.out


def test_a_data_set_passes_by_name_and_with_a_users_own_table(framework: Framework, tmp_path: Path) -> None:
    done = framework("mode=check", "data=moons", "data.noise=0.2")
    assert done.code == 0, done.out
    findings = (done.folder / "check.csv").read_text(encoding="utf-8")
    assert "as configured" in findings
    assert "damaged own files are named" in findings
    table = tmp_path / "own.csv"
    table.write_text("x,y\n" + "".join(f"{row},{'ab'[row % 3 == 0]}\n" for row in range(40)))
    done = framework("mode=check", "data=tabular", f"data.path={table}", "data.target=y")
    assert done.code == 0, done.out
    table.write_text("x,y\n" + "".join(f"{row % 5},{'ab'[row % 5 == 0]}\n" for row in range(40)))
    done = framework("mode=check", "data=tabular", f"data.path={table}", "data.target=y")
    assert done.code == 1, done.out
    assert "tabular: no sample in two splits" in done.out


def test_parameters_from_the_command_line_are_a_row(framework: Framework) -> None:
    done = framework("mode=check", "density_head=wrapped_cauchy", "density_head.largest=0.5")
    assert done.code == 0, done.out
    assert "as configured" in (done.folder / "check.csv").read_text(encoding="utf-8")


def test_a_plugin_without_rows_is_tried_with_every_target(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contracts, "_shipped", lambda group, name: ())
    for config, label in ((None, "defaults"), ({"concentration": "fixed"}, "as configured")):
        rows = contracts.contract("density_head", "von_mises", config).rows
        assert [row.name for row in rows] == [f"{label}, {angles} of kind angle" for angles in (1, 3)]
        assert [row.config.get("concentration") for row in rows] == [config and config["concentration"]] * 2


def test_a_further_row_has_the_target_that_its_parts_ask_for() -> None:
    """A uniform floor under rotations or one angle, given by name or with settings, gets no row that its head
    refuses."""
    for component, kind in (("matrix_fisher", 3), ("von_mises", 1), ("categorical", 3)):
        config = {"weight": 0.3, "component": {"name": component}}
        first, *_ = contracts.contract("density_head", "uniform_floor", config).rows
        assert first.name == "as configured" and len(first.target.names) == kind
        assert ("mode" in first.leave_out) == (component == "matrix_fisher")
    with pytest.raises(ConfigError, match="gaussian"):
        contracts.contract("density_head", "uniform_floor", {"component": {"name": "gaussian"}})


def test_nothing_chosen_is_refused(framework: Framework) -> None:
    done = framework("mode=check")
    assert done.code == 2
    assert "mode=check density_head=<name>" in done.out


# the instruments


def test_the_worst_case_is_kept() -> None:
    worst = Worst()
    worst.record(torch.tensor([[0.1, 0.5], [0.2, 0.3]]), lambda at: f"at {at}")
    worst.record(0.4, "later and smaller")
    assert worst.finding("property", 1.0) == Finding("property", "at (0, 1)", 0.5, 1.0)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_nan_is_the_worst_of_all(bad: float) -> None:
    worst = Worst()
    worst.record(torch.tensor([0.1, bad, 0.2]), lambda at: f"number {at[0]}")
    worst.record(3.0, "later and finite")
    found = worst.finding("property", 1e300)
    assert (str(found.error), found.holds) == (str(bad), False)
    assert found.worst == ("NaN: number 1" if math.isnan(bad) else "number 1")


def test_a_check_that_compares_nothing_fails() -> None:
    assert not run_check("property", 1.0, lambda worst: worst.record(torch.empty(0), "nothing")).holds


def test_what_a_check_raises_is_told() -> None:
    def look(worst: Worst) -> None:
        raise NotImplementedError("no entropy")

    found = run_check("entropy", 1.0, look)
    assert (found.worst, found.error) == ("NotImplementedError: no entropy", math.inf)


def test_an_error_of_a_plugin_is_told_with_its_line() -> None:
    density = GaussianHead(HEIGHT)(torch.zeros(1, 2))
    run = lambda worst: density.log_prob("one")  # type: ignore[arg-type]  # noqa: E731
    assert re.search(
        r"TypeError: .* \(raised at density_head/gaussian/\w+\.py:\d+\)$", run_check("", 1.0, run).worst
    )


def test_a_sentence_for_users_is_told_without_a_line() -> None:
    density = MultivariateNormal(torch.zeros(1, 2), torch.eye(2))
    worst = run_check("", 1.0, lambda worst: worst.count(marginal(density, 3).has_rsample, "")).worst
    assert "raised at" not in worst


def test_a_check_that_hangs_is_ended() -> None:
    def look(worst: Worst) -> None:
        while True:
            torch.zeros(1).add_(1)

    found = run_check("sampling", 1.0, look, seconds=0.2)
    assert not found.holds
    assert "did not end within 0.2 s" in found.worst


def test_require_names_every_failure() -> None:
    good, bad = Finding("shape", "", 0.0, 0.0), Finding("entropy", "row 3", 2.0, 1.0)
    require(good)
    with pytest.raises(AssertionError, match=r"entropy FAILS: error 2, limit 1 \(row 3\)"):
        require(good, bad)
    with pytest.raises(AssertionError, match="nothing was checked"):
        require()


def test_bits_that_differ_are_counted_and_nan_equals_nan() -> None:
    worst = Worst()
    worst.same_bits("equal", torch.tensor([1.0, math.nan]), torch.tensor([1.0, math.nan]))
    assert worst.error == 0
    worst.same_bits("one off", torch.tensor([1.0, 2.0]), torch.tensor([1.0, 2.5]))
    assert (worst.error, worst.case) == (0.5, "one off")
    worst.same_bits("shape", torch.zeros(2), torch.zeros(3))
    assert worst.error == math.inf


def test_parameters_without_an_annotation_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    class Bare:
        def __init__(self, *, width: int = 3, rate=0.5, free=None) -> None: ...

    assert check.describe_untyped("metric", "accuracy") == ""
    monkeypatch.setattr(check, "load", lambda group, name: Bare)
    assert "metric mine: the parameters rate, free have no annotation" in check.describe_untyped(
        "metric", "mine"
    )
