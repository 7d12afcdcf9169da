"""What a run says first: what it reads, what it predicts, and what it leaves out."""

from collections.abc import Sequence, Sized

from rich.console import Console

from framework.data import Data, Splits
from framework.errors import shown
from framework.target import Target

MOST = 12
"""Names that a line lists."""


def introduce(data: Data, console: Console) -> None:
    """Say what prepared data hold."""
    for line in lines(data):
        console.print(line, soft_wrap=True, highlight=False, markup=False)


def lines(data: Data) -> list[str]:
    """The first lines of a run."""
    read = (
        _listed(data.columns) if data.columns else f"inputs of shape {'×'.join(map(str, data.input_shape))}"
    )
    sizes = [
        f"{name} {len(part)}"
        for name, part in zip(Splits._fields, data.splits(), strict=True)
        if isinstance(part, Sized)
    ]
    skipped = f", {data.skipped} left out" if data.skipped else ""
    return [
        f"reads {read}",
        f"predicts {predicted(data.target)}",
        f"samples: {', '.join(sizes)}{skipped}",
        *(shown(remark, 1000) for remark in data.remarks),
    ]


def predicted(target: Target) -> str:
    """What a target is, in words."""
    if target.kind == "class":
        return f"one of {len(target.names)} classes: {_listed(target.names)}"
    if target.kind == "image":
        return f"images of {'×'.join(map(str, target.size))} pixels"
    return f"{'angles' if target.kind == 'angle' else 'numbers'}: {_listed(target.names)}"


def _listed(names: Sequence[str]) -> str:
    rest = f" and {len(names) - MOST} more" if len(names) > MOST else ""
    return shown(", ".join(names[:MOST]), 400) + rest
