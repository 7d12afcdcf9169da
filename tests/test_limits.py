"""An untrusted checkpoint or file takes at most 1 GB and 5 s until the model predicts or an error says why not."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import nn

from framework.errors import CheckpointError
from framework.storage import limits
from framework.storage.budget import Budget, building, result_bytes

MEGABYTES, SECONDS = 1000, 5.0
ROOT = Path(__file__).parent.parent


@pytest.mark.slow  # each case is a process, and there are 300
@pytest.mark.parametrize(
    ("what", "least"), [("parameters", 250), ("fields", 15), ("files", 30), ("texts", 100)]
)
def test_nothing_small_takes_much(what: str, least: int) -> None:
    """Test every number of every plugin's config, other descriptions in a checkpoint, compressed and sparse files of
    every reader, and long texts."""
    quiet = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "-m", "tests.exhausting", what],
        cwd=ROOT,
        env=os.environ | quiet,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    cases: list[dict[str, Any]] = [json.loads(line) for line in done.stdout.splitlines() if line[:1] == "{"]
    assert len(cases) >= least
    wrong = [
        f"{one['case']}: {one['seconds']:.1f} s, {one['megabytes']:.0f} MB, {one['ended'][:200]}"
        for one in cases
        if one["megabytes"] > MEGABYTES
        or one["seconds"] > SECONDS
        or re.match("killed|.*(MemoryError|can't allocate)", one["ended"])
    ]
    assert not wrong, "\n".join(wrong)


OPERATIONS = {
    "zeros": lambda: torch.zeros(300, 200),
    "randn": lambda: torch.randn(70_000),
    "arange": lambda: torch.arange(0.0, 90_000.0, 0.5),
    "linspace": lambda: torch.linspace(0, 1, 90_000),
    "eye": lambda: torch.eye(400),
    "outer": lambda: torch.ones(500, 1) * torch.ones(1, 500),
    "expanded": lambda: torch.ones(1).expand(400_000).clone(),
    "product": lambda: torch.ones(500, 2) @ torch.ones(2, 500),
    "batched": lambda: torch.ones(8, 200, 2) @ torch.ones(8, 2, 200),
    "linear": lambda: nn.functional.linear(torch.ones(500, 2), torch.ones(500, 2), torch.ones(500)),
    "convolution": lambda: nn.functional.conv2d(torch.ones(1, 1, 60, 60), torch.ones(64, 1, 3, 3), stride=2),
    "its transpose": lambda: nn.functional.conv_transpose2d(
        torch.ones(1, 2, 60, 60), torch.ones(2, 16, 3, 3), stride=2
    ),
    "padding": lambda: nn.functional.pad(torch.ones(1, 3, 4, 4), (100, 100, 100, 100)),
    "scaling": lambda: nn.functional.interpolate(torch.ones(1, 3, 4, 4), (300, 300)),
    "repeating": lambda: torch.ones(10, 10).repeat(30, 30),
    "picking": lambda: torch.ones(3, 100)[torch.zeros(4000, dtype=torch.int64)],
    "embedding": lambda: nn.functional.embedding(torch.zeros(4000, dtype=torch.int64), torch.ones(3, 100)),
    "distances": lambda: torch.cdist(torch.ones(500, 3), torch.ones(400, 3)),
    "diagonals": lambda: torch.diag_embed(torch.ones(10, 200)),
    "joining": lambda: torch.cat([torch.ones(50_000), torch.ones(50_000)]),
}


@pytest.mark.parametrize("name", OPERATIONS)
def test_a_size_is_known_before_the_operation_runs(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The computed size is between one and two times the size of the result; a limit one byte lower is refused."""
    seen: list[tuple[int, int]] = []
    original = Budget.__torch_dispatch__

    def compared(
        self: Budget, func: Any, types: Any, args: tuple[Any, ...] = (), kwargs: dict[str, Any] | None = None
    ) -> Any:
        computed = result_bytes(func, args, kwargs or {})
        found = original(self, func, types, args, kwargs)
        if isinstance(found, torch.Tensor) and computed:
            seen.append((computed, found.numel() * found.element_size()))
        return found

    monkeypatch.setattr(Budget, "__torch_dispatch__", compared)
    with Budget("model.ckpt", 2**30):
        OPERATIONS[name]()
    computed, taken = max(seen, key=lambda one: one[1])
    assert taken <= computed <= 2 * taken
    monkeypatch.undo()
    with (
        pytest.raises(
            CheckpointError,
            match=r"^model\.ckpt: the model takes far more memory than its weights and inputs explain",
        ),
        Budget("model.ckpt", taken - 1),
    ):
        OPERATIONS[name]()


def test_what_was_freed_is_not_counted() -> None:
    with Budget("model.ckpt", 3 * 2**20):
        for _ in range(50):
            kept = torch.zeros(2**18)  # 1 MB, and the one before
        assert len(kept) == 2**18


def test_layers_that_take_no_memory_are_counted() -> None:
    most = limits.BUILDING_CALLS + limits.CALLS_PER_WEIGHT
    with (
        pytest.raises(CheckpointError, match="far more layers or steps"),
        building("model.ckpt", [torch.zeros(1)]),
    ):
        for _ in range(most + 1):
            torch.zeros(1)
