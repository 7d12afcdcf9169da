"""Densities under mixed precision, whose numbers must not change."""

from collections.abc import Callable, Iterator

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.distributions.normals import JointNormal
from framework.runs import fit
from framework.testing.contract import contract
from framework.testing.finding import SEED, seed
from framework.testing.head_subject import HeadSubject, fit_if_needed
from framework.testing.rows import HeadRow

HEADS = [
    pytest.param(name, row, id=f"{name}: {row.name}")
    for name in installed("density_head")
    for row in contract("density_head", name).rows
]


def answers(density: Distribution, value: Tensor) -> Iterator[tuple[str, Tensor]]:
    """Return log-densities and draws, with the same random numbers in each call."""
    asked: dict[str, Callable[[], Tensor]] = {
        "log_prob": lambda: density.log_prob(value),
        "sample": lambda: density.sample(torch.Size((3,))),
    }
    for name, ask in asked.items():
        seed(SEED)
        with torch.no_grad():
            yield name, ask()


def require_same(make: Callable[[], Distribution], value: Tensor, kind: torch.dtype) -> None:
    wanted = dict(answers(make(), value))
    density = make()
    with torch.autocast("cpu", kind):
        found = dict(answers(density, value))
    for name, one in found.items():
        torch.testing.assert_close(
            one, wanted[name], rtol=1e-5, atol=1e-5, msg=lambda told, name=name: f"{name}: {told}"
        )


@pytest.mark.parametrize("name, row", HEADS)
def test_densities_of_heads_are_those_of_full_precision(name: str, row: HeadRow) -> None:
    config = resolve("density_head", {"name": name, **row.config})
    subject = HeadSubject(
        row, lambda: fit_if_needed(build("density_head", config, target=row.target), row.target)
    )
    head, raw, value = subject.make(), row.scale * subject.raw_parameters(4), subject.values(4)

    def make() -> Distribution:
        seed(SEED)
        with torch.no_grad():
            return head(raw)

    require_same(make, value, torch.bfloat16)


@pytest.mark.parametrize("kind", [torch.bfloat16, torch.float16])
def test_a_joint_normal_is_that_of_full_precision(kind: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(0)
    root = torch.randn(4, 3, 3, generator=generator).tril() + 2 * torch.eye(3)
    root.diagonal(dim1=-2, dim2=-1).abs_()
    mean, value = (torch.randn(4, 3, generator=generator) for _ in range(2))
    require_same(lambda: JointNormal(mean, root), value, kind)


@pytest.mark.parametrize(
    ("accelerator", "fast", "precision"),
    [
        ("cpu", True, "bf16-mixed"),
        (None, True, "bf16-mixed"),
        ("cpu", False, "32-true"),
        ("tpu", True, "32-true"),
    ],
)
def test_automatic_precision_is_bfloat16_on_processors_with_fast_products(
    accelerator: str | None, fast: bool, precision: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fit, "fast_bfloat16", lambda device: fast)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert fit._fast_precision(accelerator) == precision
