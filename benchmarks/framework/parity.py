"""Export every encoder, density head and wrapper of the contract tables, and record how far the exported models differ.

    python -m benchmarks.framework.parity [ENCODER ...]

Every contract row of an encoder is exported with one density head, every row of a density head and of a wrapper with
one encoder, and the first row of every encoder with the first row of every density head. The script measures the named
encoders, or all; `heads` and `wrappers` stand for the other two tables. The weights are random. It writes parity.csv
and parity.md beside this file; the rows of parts that are not named are kept.
"""

import csv
import re
import sys
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import torch

from benchmarks.framework.deployed import Arrays
from benchmarks.pages import machine, write_page
from framework.configuration.assembly import build_predictor
from framework.configuration.description import Description
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.data import Data
from framework.deployment import export as exporting
from framework.errors import UserError
from framework.target import Target
from framework.testing.contract import contract
from framework.testing.rows import EncoderRow, HeadRow, WrapperRow

TABLE = Path(__file__).with_suffix(".csv")
COLUMNS: list[str] = [
    "encoder",
    "row",
    "head",
    "head row",
    "wrapper",
    "random",
    "extreme",
    "log-density",
    "reason",
]
CLASSES = Target("class", ("a", "b", "c"))
MLP = {"name": "mlp", "widths": [16]}
WITHOUT_PAIRS = ("inception_resnet_v2",)
"""Encoders that are exported with one density head only, because an export takes most of a minute."""
Part = Mapping[str, Any]


def rows(group: str, name: str) -> list[Any]:
    """Return the contract rows of a plugin."""
    return list(contract(group, name).rows)


def reader(description: Description) -> Data:
    """Return data whose users give arrays of the model's inputs."""
    Arrays.__abstractmethods__ = frozenset()  # type: ignore[attr-defined]
    data = Arrays()  # type: ignore[abstract]
    data.input_shape, data.columns = description.input_shape, description.columns
    return data


def export(
    encoders: Sequence[Part], head: Part, target: Target, row: EncoderRow, wrappers: Sequence[Part] = ()
) -> dict[str, str]:
    """Return the differences of an exported model with these parts, or the reason for which it is refused."""
    torch.manual_seed(0)
    try:
        config = {
            "encoder": [resolve("encoder", part) for part in encoders],
            "density_head": resolve("density_head", head),
            "uncertainty": [resolve("uncertainty", part) for part in wrappers],
        }
        model = build_predictor(config, target, row.input_shape, 0, row.columns).eval()
    except UserError as error:
        return {"reason": f"no model: {error}"}
    description = Description(
        {"data": {"name": "arrays"}}, target, row.input_shape, row.columns, synthetic=True, method="tried"
    )
    with tempfile.TemporaryDirectory() as folder:
        try:
            parity = exporting.export(model, description, Path(folder) / "exported")["parity"]
        except UserError as error:
            reason = str(error).removeprefix("The model tried cannot be exported. ")
            reason = re.sub(rf"{re.escape(tempfile.gettempdir())}/[\w/.-]+", "a folder", reason)
            return {"reason": reason.removesuffix(" Use framework.load or framework.freeze for it.")}
    numbers = {name: f"{parity[name]['parameters']:.1e}" for name in ("random", "extreme")}
    density = parity["random"].get("log_density")
    return {**numbers, "log-density": "" if density is None else f"{density:.1e}"}


def vectors() -> EncoderRow:
    """Return a row of an encoder that reads six numbers."""
    return EncoderRow("six numbers", (6,))


def encoder_chain(name: str, row: EncoderRow) -> list[Part]:
    """Return an encoder, with a network behind it that makes its features a vector."""
    return [{"name": name, **row.config}, MLP]


def of_encoder(name: str) -> Iterator[dict[str, str]]:
    """Yield the table rows of an encoder: its own rows, then its first row with every density head."""
    own = rows("encoder", name)
    for row in own:
        result = export(encoder_chain(name, row), {"name": "categorical"}, CLASSES, row)
        yield {"encoder": name, "row": row.name, "head": "categorical", **result}
        if "reason" in result and row is own[0]:
            own = own[1:]
    if not own or name in WITHOUT_PAIRS:
        return
    for head in installed("density_head"):
        first: HeadRow = rows("density_head", head)[0]
        part = {"name": head, **first.config}
        result = export(encoder_chain(name, own[0]), part, first.target, own[0])
        if not result.get("reason", "").startswith("no model"):
            yield {"encoder": name, "row": own[0].name, "head": head, "head row": first.name, **result}


def of_heads() -> Iterator[dict[str, str]]:
    """Yield the table rows of all rows of density heads."""
    for head in installed("density_head"):
        for row in rows("density_head", head):
            part = {"name": head, **row.config}
            result = export([MLP], part, row.target, vectors())
            if result.get("reason", "").startswith("no model"):
                result = export([], part, row.target, EncoderRow("raw", (_size(part, row.target),)))
            yield {"encoder": "mlp", "row": "six numbers", "head": head, "head row": row.name, **result}


def _size(part: Part, target: Target) -> int:
    """Return the number of raw parameters of a head that reads features themselves."""
    size: int = build("density_head", resolve("density_head", part), target=target).size
    return size


def of_wrappers() -> Iterator[dict[str, str]]:
    """Yield the table rows of all rows of wrappers."""
    for name in installed("uncertainty"):
        for row in rows("uncertainty", name):
            assert isinstance(row, WrapperRow)
            head = next(
                head for head in ("gaussian", "von_mises", "categorical") if _accepts(head, row.target)
            )
            network = {**MLP, "dropout": 0.2}
            result = export([network], {"name": head}, row.target, vectors(), [{"name": name, **row.config}])
            yield {
                "encoder": "mlp",
                "row": "six numbers",
                "head": head,
                "wrapper": f"{name}, {row.name}",
                **result,
            }


def _accepts(head: str, target: Target) -> bool:
    kinds = {"gaussian": "real", "von_mises": "angle", "categorical": "class"}
    return kinds[head] == target.kind


def key(line: Mapping[str, str]) -> str:
    """Return the name of the part of the table to which a row belongs."""
    if line.get("wrapper"):
        return "wrappers"
    return "heads" if line["row"] == "six numbers" else line["encoder"]


def write(lines: Sequence[Mapping[str, str]]) -> None:
    """Write the table and the page."""
    with TABLE.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, COLUMNS, restval="", lineterminator="\n")
        writer.writeheader()
        writer.writerows(dict(line) for line in lines)
    exported = [line for line in lines if not line.get("reason")]
    refused = [line for line in lines if line.get("reason")]
    worst = {
        name: max((float(line[name]) for line in exported if line.get(name)), default=0.0)
        for name in ("random", "extreme", "log-density")
    }
    pairs = {(line["encoder"], line["head"]) for line in exported}
    text = [
        "# Exported models: differences from the original model",
        "",
        "This page says which models `mode=export` writes, and how far the exported models differ from the original "
        "ones. The export itself makes the comparison, and writes nothing if a difference is too large "
        "([docs/export.md](../../docs/export.md)).",
        "",
        f"The comparison has {len(lines)} models with random weights. Of these, {len(exported)} are exported, "
        f"with {len(pairs)} pairs of an encoder and a density head, and {len(refused)} are refused. "
        f"{' and '.join(WITHOUT_PAIRS)} is exported with one density head only. The parameters of the densities "
        f"differ by at most {worst['random']:.1e} for random inputs and {worst['extreme']:.1e} for extreme "
        "inputs, as a share of the largest number in a row; 1e-5 is allowed. Log-densities differ by at most "
        f"{worst['log-density']:.1e} for random inputs, as a share of max(1, |log-density|); 1e-4 is allowed.",
        "",
        "Differences for extreme inputs come from rounding in float32, and depend on the weights: where a result is "
        "close to 0, the rounding errors of the large numbers in the layers are a large share of the result. A "
        "difference above 1e-5 is therefore accepted if the error of the exported network, compared with the model in "
        "float64, is at most four times the error of the original model.",
        "",
        "## Refused models",
        "",
        "| encoder | density head | wrapper | reason |",
        "|---|---|---|---|",
        *_refusals(refused),
        "",
        "## Exported models",
        "",
        "The table has a row for each encoder and for each density head. A difference is the largest one over all "
        "models that contain this encoder or head. [parity.csv](parity.csv) holds every model.",
        "",
        "| encoder | density heads | models | random | extreme |",
        "|---|---|---|---|---|",
        *_summary(exported),
        "",
        f"{machine('torch', 'onnx', 'onnxscript', 'onnxruntime', 'numpy')} Command: "
        "`python -m benchmarks.framework.parity`.",
        "",
    ]
    write_page(__file__, "\n".join(text))


def _refusals(refused: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the table rows of refused models, one for each reason and part."""
    lines: dict[str, None] = {}
    heads = {(line["head"], line["reason"]) for line in refused if key(line) == "heads"}
    for line in refused:
        # a head that no encoder changes is listed once
        if key(line) not in ("heads", "wrappers") and (line["head"], line["reason"]) in heads:
            continue
        encoder = f"{line['encoder']}: {line['row']}" if key(line) not in ("heads", "wrappers") else "any"
        head = f"{line['head']}: {line['head row']}" if line.get("head row") else "any"
        wrapper = line.get("wrapper") or "-"
        lines[f"| {encoder} | {head} | {wrapper} | {line['reason'].replace('|', ' ')} |"] = None
    return list(lines)


def _summary(exported: Sequence[Mapping[str, str]]) -> list[str]:
    """Return the table rows of exported models, one for each encoder."""
    lines = []
    for encoder in sorted({line["encoder"] for line in exported}):
        own = [line for line in exported if line["encoder"] == encoder]
        heads = ", ".join(sorted({line["head"] for line in own}))
        worst = [max(float(line[name]) for line in own) for name in ("random", "extreme")]
        lines.append(f"| {encoder} | {heads} | {len(own)} | {worst[0]:.1e} | {worst[1]:.1e} |")
    return lines


def read_table() -> list[dict[str, str]]:
    """Return the rows of the table that an earlier run wrote."""
    if not TABLE.exists():
        return []
    with TABLE.open(encoding="utf-8", newline="") as stream:
        return list(csv.DictReader(stream))


def main() -> None:
    exporting.reader = reader  # type: ignore[assignment]
    exporting._latency = lambda *_: {}  # type: ignore[assignment]  # run times are not compared here
    for name in sys.argv[1:] or [*installed("encoder"), "heads", "wrappers"]:
        if name == "heads":
            results = list(of_heads())
        elif name == "wrappers":
            results = list(of_wrappers())
        else:
            results = list(of_encoder(name))
        lines = [line for line in read_table() if key(line) != name] + results
        write(sorted(lines, key=lambda line: (key(line) in ("heads", "wrappers"), key(line))))


if __name__ == "__main__":
    main()
