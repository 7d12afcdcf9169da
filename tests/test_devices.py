"""Detection of mixed devices by `mode=check`, and its silence about the framework's own densities."""

import re
import sys
from collections.abc import Callable

import numpy as np
import pytest
import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, Normal

from framework.distributions.density import Mixture
from framework.distributions.intervals import central_interval
from framework.prediction import Prediction, table_columns
from framework.target import Target
from framework.testing.devices import Calls, OneDevice, check_devices
from framework.testing.finding import Worst
from framework.testing.protocol_checks import protocol_calls
from plugins.density_head.von_mises.density import VonMises
from tests.planted_heads import CLASSES, HEIGHT, ONE, PLACE


def sign_by_device(x: Tensor) -> Tensor:
    """Return -x, by separate code for each kind of device."""
    return x.neg() if x.is_cuda else 0 - x


RIGHT: dict[str, Callable[[Tensor], object]] = {
    "single numbers in arithmetic": lambda x: x * torch.tensor(2.0) + torch.where(x > 0, x, torch.zeros(())),
    "an index of the CPU": lambda x: x[torch.arange(2)] + x[torch.ones(3, dtype=torch.bool)][:2],
    "a mask of the CPU is filled": lambda x: x.clone().__setitem__(torch.ones(3, dtype=torch.bool), 0.0),
    "slices are copied": lambda x: x.clone().__setitem__(slice(0, 2), torch.ones(2)),
    "copy_": lambda x: torch.empty(3).copy_(x).numpy(),
    "made on its device": lambda x: x + torch.arange(3, device=x.device),
    "made like it": lambda x: x + x.new_tensor([1.0, 2.0, 3.0]) + torch.ones_like(x) + x.new_zeros(3),
    "moved to it": lambda x: torch.stack(
        [x, torch.ones(3).to(x), torch.ones(3).to(x.device), torch.ones(3).type_as(x)]
    ),
    "moved away from it": lambda x: torch.ones(3) + torch.from_numpy(x.cpu().numpy()) + x.detach().to("cpu"),
    "moved there and back": lambda x: x + torch.from_numpy(x.cpu().numpy()).to(x.device),
    "by where it is": lambda x: torch.from_numpy(x.numpy()) + x if not x.is_cuda else x,
    "given to code for each device": lambda x: x + sign_by_device(torch.ones_like(x)),
    "Python numbers": lambda x: torch.tensor([x[0].item(), *x.tolist()]) + torch.ones(4),
    "sums of rows": lambda x: sum(torch.tensor(row.item()) for row in x) + x,
}
WRONG: dict[str, Callable[[Tensor], object]] = {
    "numbers of the CPU in arithmetic": lambda x: x * torch.ones(3),
    "made on the CPU": lambda x: x + torch.ones(3, device="cpu"),
    "made where one of the CPU is": lambda x: x + torch.ones(3, device=torch.ones(1).device),
    "single numbers stacked": lambda x: torch.stack([x[0], torch.zeros(())]),
    "searched among numbers of the CPU": lambda x: torch.searchsorted(torch.arange(3.0), x),
    "gathered by an index of the CPU": lambda x: x.gather(0, torch.zeros(2, dtype=torch.int64)),
    "an index of the device into the CPU": lambda x: torch.ones(3)[x.argsort()],
    "indexed numbers are not copied": lambda x: x.clone().__setitem__(torch.arange(2), torch.ones(2)),
    "a matrix of the CPU": lambda x: torch.eye(3) @ x,
    "NumPy": lambda x: x.numpy(),
    "NumPy through a function": lambda x: np.asarray(x),
    "views of the CPU": lambda x: x + torch.zeros(2, 3)[0].expand(3).double().float(),
    "rows of the CPU": lambda x: [row + x for row in torch.zeros(2, 3)],
    "a mask of the CPU": lambda x: x.masked_fill(torch.ones(3, dtype=torch.bool), 0.0),
    "written in place": lambda x: torch.zeros(3).add_(x),
    "made on the CPU and given to code for each device": lambda x: x + sign_by_device(torch.ones(3)),
    "weights of a mixture": lambda x: Mixture(
        torch.zeros(3, 2), of_normals(x[:, None, None].expand(3, 2, 1))
    ).log_prob(x[:, None]),
}


def mixes(ask: Callable[[Tensor], object]) -> bool:
    mode = OneDevice()
    x = mode.label_device(torch.tensor([0.3, 0.1, 0.7]))
    with mode:
        ask(x)
    return bool(mode.faults)


@pytest.mark.parametrize("name", RIGHT)
def test_what_cuda_allows_is_no_fault(name: str) -> None:
    assert not mixes(RIGHT[name])


@pytest.mark.parametrize("name", WRONG)
def test_what_cuda_refuses_is_a_fault(name: str) -> None:
    assert mixes(WRONG[name])


def test_a_fault_names_the_line_that_made_the_tensor_of_the_cpu() -> None:
    mode = OneDevice()
    x = mode.label_device(torch.tensor([0.3, 0.1, 0.7]))
    with mode:
        made = torch.ones(3)
        line = sys._getframe().f_lineno - 1
        _ = x + made.double().exp()
    (fault,) = mode.faults
    assert re.search(rf"\(3,\) on the CPU \(created at \S*tests/test_devices\.py:{line}\)", fault)


def of_normals(raw: Tensor) -> Distribution:
    return Independent(Normal(raw, 1 + raw.square(), validate_args=False), 1, validate_args=False)


def of_angles(raw: Tensor) -> Distribution:
    return VonMises(raw, 1 + raw.square())


def of_classes(raw: Tensor) -> Distribution:
    return Categorical(logits=raw, validate_args=False)


@pytest.mark.parametrize("mixed", [False, True], ids=["alone", "mixed"])
@pytest.mark.parametrize(
    "target, make",
    [(HEIGHT, of_normals), (PLACE, of_normals), (ONE, of_angles), (CLASSES, of_classes)],
    ids=["one real", "two reals", "one angle", "classes"],
)
def test_the_answers_of_a_density_are_on_its_device(
    target: Target, make: Callable[[Tensor], Distribution], mixed: bool
) -> None:
    def calls(mode: OneDevice) -> Calls:
        raw = mode.label_device(torch.randn(2, 3, len(target.names)))
        density = Mixture(raw[..., 0].log_softmax(-1), make(raw)) if mixed else make(raw[:, 0])
        yield from protocol_calls(
            density, mode.label_device(torch.tensor([[0], [1], [0]])), mode.label_device(torch.tensor(1.7))
        )
        if target.kind != "class":
            yield "middle", lambda: central_interval(density, 0.9, 99)
        batch = {"index": mode.label_device(torch.arange(2)), "target": density.sample()}
        yield "answers", lambda: table_columns(target, Prediction(density, batch))

    worst = Worst()
    check_devices(calls, worst)
    assert worst.error == 0, worst.case
