"""Costs, compared with counts by hand, known allocations and scripted clocks."""

import math
from pathlib import Path

import pytest
import torch
from torch import Tensor, nn

from framework.configuration.schema import build, resolve
from framework.configuration.settings import Settings
from framework.evaluation import cost
from framework.evaluation.cost import Cost, device_name, measure, peak_memory, wall_time
from framework.evaluation.splits import cost as evaluated_cost
from framework.model import Model
from framework.reports.table import COST_COLUMNS
from framework.target import Target

CPU = torch.device("cpu")


def quick(predict, inputs: Tensor) -> Cost:
    return measure(predict, inputs, parameters=0, repeats=3, budget_seconds=1e-9)


def test_flops_of_a_linear_layer_are_two_per_weight() -> None:
    assert quick(nn.Linear(10, 20), torch.randn(4, 10)).flops_per_sample == 2 * 10 * 20


@pytest.mark.parametrize("groups", [1, 2])
def test_flops_of_a_convolution_are_two_per_weight_and_pixel(groups: int) -> None:
    layer = nn.Conv2d(4, 6, kernel_size=3, stride=2, groups=groups)
    high, wide = 4, 5  # (9 - 3) / 2 + 1 and (11 - 3) / 2 + 1
    by_hand = 2 * 3 * 3 * (4 // groups) * 6 * high * wide
    assert quick(layer, torch.randn(3, 4, 9, 11)).flops_per_sample == by_hand


def test_element_wise_work_counts_no_flops() -> None:
    assert quick(torch.special.i0e, torch.randn(5, 7)).flops_per_sample == 0


def test_what_cannot_be_counted_is_not_said_to_be_none() -> None:
    found = measure(nn.Linear(3, 2), torch.randn(8, 3), parameters=None, repeats=3, budget_seconds=0.1)
    assert found.flops_per_sample is None and found.parameters is None
    assert found.milliseconds_per_sample > 0


@pytest.mark.parametrize("name, counted", [("extra_trees", False), ("categorical", True)])
def test_of_trees_neither_flops_nor_parameters_are_counted(name: str, counted: bool) -> None:
    head = build("density_head", resolve("density_head", {"name": name}), target=Target("class", ("a", "b")))
    batch = {"input": torch.randn(20, 4), "target": torch.arange(20) % 2, "index": torch.arange(20)}
    if not counted:
        head.fit(batch["input"], batch["target"], 0)
    found = evaluated_cost(Model([], head, (4,)), batch, samples=1, device=CPU)
    assert (found.parameters is not None) == (found.flops_per_sample is not None) == counted
    if counted:
        assert (found.parameters, found.flops_per_sample) == (2 * 4 + 2, 2 * 2 * 4)


def test_every_field_says_what_was_measured() -> None:
    found = measure(nn.Linear(3, 2), torch.randn(8, 3), parameters=8, repeats=3, budget_seconds=0.1)
    assert (found.batch_size, found.parameters, found.threads) == (8, 8, torch.get_num_threads())
    assert found.device == device_name(CPU)
    assert found.milliseconds_per_sample > 0
    assert found.latency_milliseconds > 0
    assert set(COST_COLUMNS) <= set(Cost.__dataclass_fields__)


def test_gradients_are_off_and_random_numbers_stay_where_they_were() -> None:
    graphs = []

    def predict(inputs: Tensor) -> Tensor:
        graphs.append(torch.is_grad_enabled())
        return inputs + torch.randn_like(inputs)

    torch.manual_seed(3)
    before = torch.get_rng_state()
    quick(predict, torch.zeros(2, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert not any(graphs)


def test_a_spent_budget_still_times_three_calls_after_two_to_warm_up() -> None:
    sizes = []
    quick(lambda inputs: sizes.append(len(inputs)), torch.zeros(6, 1))
    assert sizes.count(1) == 2 + 3
    assert sizes.count(6) == 2 + 3 + 1 + 1  # FLOPs and memory are counted in calls of their own


def test_wall_time_is_the_median_without_the_warm_up(monkeypatch: pytest.MonkeyPatch) -> None:
    script = iter([100.0, 100.0, 3.0, 1.0, 50.0, 2.0, 4.0])
    monkeypatch.setattr(cost, "time_call", lambda call, device: next(script))
    assert wall_time(lambda: None, CPU, repeats=5, budget_seconds=60.0) == 3.0


def test_time_is_divided_by_the_batch_but_latency_is_not(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cost, "wall_time", lambda call, device, **limits: 0.5)
    found = quick(nn.Linear(1, 1), torch.zeros(10, 1))
    assert found.milliseconds_per_sample == 50.0
    assert found.latency_milliseconds == 500.0


@pytest.mark.parametrize(
    "mebibytes", [8, 48]
)  # from the allocator's heap, which it keeps, and from the system
def test_memory_is_what_one_call_holds_at_once_whatever_ran_before(mebibytes: int) -> None:
    numbers = mebibytes * 2**20 // 4

    def call() -> Tensor:
        first, second = torch.ones(numbers), torch.ones(numbers)
        return (first + second).sum()  # three arrays at once

    torch.ones(30 * 2**18)  # 30 MiB, after which the allocator keeps as much for later
    for _ in range(3):
        call()
    found = peak_memory(call, CPU) / 2**20
    told = Path("/proc/self/clear_refs").exists()
    assert found == pytest.approx(3 * mebibytes, abs=1.5) if told else math.isnan(found)


def test_memory_is_not_available_where_the_system_forbids_to_reset_its_peak(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def forbid(path: Path, text: str) -> int:
        raise PermissionError(13, "Permission denied", str(path))

    monkeypatch.setattr(Path, "write_text", forbid)
    assert math.isnan(peak_memory(lambda: None, CPU))


def test_memory_of_an_unknown_device_is_not_available() -> None:
    assert math.isnan(peak_memory(lambda: None, torch.device("meta")))


def test_device_name_tells_kind_and_model(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(torch.cuda, "get_device_name", lambda device: "Some GPU")
    assert device_name(torch.device("cuda", 0)) == "cuda (Some GPU)"
    assert device_name(CPU).startswith("cpu (")
    assert device_name(torch.device("meta")) == "meta"


@pytest.mark.parametrize("inputs", [torch.zeros(0, 3), torch.tensor(1.0)])
def test_an_empty_batch_is_refused(inputs: Tensor) -> None:
    with pytest.raises(ValueError, match="at least one sample"):
        quick(nn.Identity(), inputs)


@pytest.mark.parametrize(("repeats", "budget"), [(0, 1.0), (1, 0.0), (1, math.nan)])
def test_impossible_limits_are_refused(repeats: int, budget: float) -> None:
    with pytest.raises(ValueError, match="budget_seconds above 0"):
        wall_time(lambda: None, CPU, repeats=repeats, budget_seconds=budget)


@pytest.mark.parametrize(
    ("trainer", "short"),
    [
        ({"max_epochs": 1, "limit_train_batches": 3}, True),
        ({"max_epochs": 4, "limit_train_batches": 3}, False),
        ({"max_epochs": 1, "limit_train_batches": 0.5}, False),
        ({"max_epochs": 1}, False),
        ({"max_epochs": None, "limit_train_batches": 3}, False),
    ],
)
def test_only_a_run_of_few_batches_is_a_short_test(trainer: dict[str, float | None], short: bool) -> None:
    assert Settings.of({"trainer": trainer}).is_short_test == short
