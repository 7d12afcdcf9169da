"""Measure the web service of an exported model under load, beside `mlflow models serve`.

    python -m benchmarks.framework.serving [table] [clouds]

The script trains a model of a table and a classifier of point clouds on generated data, exports both, and starts the
exported service and MLflow's server of the same run one after the other, in interleaved rounds. A client of this file
sends requests over eight connections. The script also sends malformed requests. It measures the named models, or both,
and writes serving.csv and serving.md beside this file; the rows of a model that is not named are kept.
"""

import asyncio
import base64
import contextlib
import csv
import json
import os
import random
import re
import shutil
import struct
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.commands import carry_out
from benchmarks.framework.served import QUICK, free_port, run_server, start_server
from benchmarks.pages import machine, write_page
from benchmarks.timing import median_and_range
from plugins.data.labelled_clouds.rows import ROWS

ROUNDS, CONNECTIONS = 5, 8
REQUESTS = {"exported": 1500, "mlflow": 150}
"""Number of requests of a round, by server."""
MALFORMED = 1000
POINTS = 2048
NETWORK = ("encoder.mlp.widths=[400,400]", *(part for part in QUICK if "widths" not in part))


@dataclass(frozen=True)
class Body:
    """A request.

    Attributes:
        path: path of the address.
        content: body.
        kind: content type.
    """

    path: str
    content: bytes
    kind: str = "application/json"

    def raw(self) -> bytes:
        """Return the request as it is sent."""
        head = (
            f"POST {self.path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: {self.kind}\r\n"
            f"Content-Length: {len(self.content)}\r\n\r\n"
        )
        return head.encode() + self.content


@dataclass(frozen=True)
class Load:
    """Result of one round.

    Attributes:
        rate: answered requests per second.
        waits: response time of each request, milliseconds.
        processor: processor time of the server for one request, milliseconds.
    """

    rate: float
    waits: Sequence[float]
    processor: float


async def ask(
    reader: asyncio.StreamReader, writer: asyncio.StreamWriter, request: bytes
) -> tuple[int, bytes]:
    """Send a request over an open connection, and return the status and the body of the answer."""
    writer.write(request)
    head = await reader.readuntil(b"\r\n\r\n")
    length = re.search(rb"content-length: (\d+)", head, re.IGNORECASE)
    assert length is not None, head
    return int(head.split(b" ", 2)[1]), await reader.readexactly(int(length[1]))


async def put_under_load(port: int, request: bytes, count: int) -> list[float]:
    """Return the response times of `count` requests over CONNECTIONS connections, milliseconds."""
    waits: list[float] = []
    left = iter(range(count))

    async def work() -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        for _ in left:
            start = time.perf_counter()
            status, text = await ask(reader, writer, request)
            waits.append(1e3 * (time.perf_counter() - start))
            assert status == 200, text
        writer.close()

    await asyncio.gather(*(work() for _ in range(CONNECTIONS)))
    return waits


def processor_seconds(port: int) -> float:
    """Return the processor time of the processes that listen on a port, and of their children, seconds."""
    lines = Path("/proc/net/tcp").read_text().splitlines()[1:]
    inodes = {
        line.split()[9]
        for line in lines
        if line.split()[1].endswith(f":{port:04X}") and line.split()[3] == "0A"
    }
    total = 0.0
    for process in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):
            sockets = {str(file.readlink()) for file in (process / "fd").iterdir()}
            if sockets & {f"socket:[{inode}]" for inode in inodes}:
                user, system = (process / "stat").read_text().rpartition(")")[2].split()[11:13]
                total += (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")
    return total


def measure(port: int, body: Body, count: int) -> Load:
    """Return the load that a server carries, after some requests to warm up."""
    asyncio.run(put_under_load(port, body.raw(), 2 * CONNECTIONS))
    before, start = processor_seconds(port), time.perf_counter()
    waits = asyncio.run(put_under_load(port, body.raw(), count))
    seconds = time.perf_counter() - start
    return Load(count / seconds, waits, 1e3 * (processor_seconds(port) - before) / count)


@contextlib.contextmanager
def start_service(folder: Path) -> Iterator[int]:
    """Start the service of an exported model, wait until it accepts connections, and yield its port."""
    port = free_port()
    script = [sys.executable, str(folder / "serve.py"), "--port", str(port)]
    with run_server(script, port, folder):
        yield port


def first_wait(port: int, body: Body) -> float:
    """Return the response time of the first request, milliseconds."""
    return asyncio.run(send_once(port, body.raw()))[2]


async def send_once(port: int, request: bytes) -> tuple[int, bytes, float]:
    start = time.perf_counter()
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    status, text = await ask(reader, writer, request)
    writer.close()
    return status, text, 1e3 * (time.perf_counter() - start)


def malformed(good: Body, generator: random.Random) -> Body:
    """Return a random malformed request, or a valid one whose bytes are changed at random."""
    deep = generator.randrange(20, 100_000)
    text = good.content
    cut = text[: generator.randrange(len(text))]
    changed = bytearray(text)
    for _ in range(8):
        changed[generator.randrange(12 if good.kind != "application/json" else len(text))] = (
            generator.randrange(256)
        )
    header = b"{'descr': '<f8', 'fortran_order': False, 'shape': (%d,), }" % (
        10 ** generator.randrange(3, 18)
    )
    npy = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header
    bodies = [
        b"[" * deep,
        b"[" * deep + b"]" * deep,
        b'{"inputs": ' + b"[" * deep + b"1" + b"]" * deep + b"}",
        b'{"inputs": ' + b'{"a":' * deep + b"1" + b"}" * deep + b"}",
        b'{"inputs": [[' + b"9" * deep + b"]]}",
        b'{"inputs": [[1e999, NaN, 0, 0, 0]]}',
        b'{"inputs": [[null, "x", 0, 0, 0]]}',
        b'{"inputs": [[1, 2], [3]]}',
        b'{"inputs": "/etc/passwd"}',
        b'{"inputs": [], "interval": {}}',
        b'{"inputs": [[0, 0, 0, 0, 0]], "interval": 7}',
        b'{"inputs": [[0, 0, 0, 0, 0]], "other": 7}',
        generator.randbytes(generator.randrange(1, 2000)),
        cut,
        bytes(changed),
        npy,
        b"PK\x03\x04" + generator.randbytes(100),
        b"",
    ]
    kind = generator.choice(["application/json", "application/octet-stream", "text/plain", good.kind])
    return Body(good.path, generator.choice(bodies), kind)


def send_malformed(port: int, good: Body, folder: Path) -> Counter[int]:
    """Send malformed requests; return how often each status was answered.

    Bytes that are changed at random may still be a valid request, so a few answers are 200.
    """
    generator = random.Random(0)
    statuses: Counter[int] = Counter()
    for _ in range(MALFORMED):
        status, text, _ = asyncio.run(send_once(port, malformed(good, generator).raw()))
        statuses[status] += 1
        assert status == 200 or 400 <= status < 500, (status, text)
        hidden = (str(folder).encode(), b"site-packages", b"Traceback", b".py", b"0x")
        assert status == 200 or not any(part in text for part in hidden), text
    assert asyncio.run(send_once(port, good.raw()))[0] == 200
    return statuses


def train(base: Path, name: str, *arguments: str) -> Path:
    """Train and export a model; return the folder that holds the run, the exported model and a model of MLflow."""
    folder = base / name
    run = [*arguments, f"hydra.run.dir={folder / 'run'}"]
    carry_out([sys.executable, "-m", "framework", *run])
    export = [
        "mode=export",
        f"checkpoint={folder / 'run'}",
        f"mode.into={folder / 'exported'}",
        "logger=none",
    ]
    carry_out([sys.executable, "-m", "framework", *export, f"hydra.run.dir={folder / 'export'}"])
    model = folder / "mlflow"
    model.mkdir()
    shutil.copy(folder / "run" / "checkpoints" / "model.ckpt", model / "model.ckpt")
    flavor = {"loader_module": "framework.deployment.served", "data": "model.ckpt", "python_version": "3.11"}
    (model / "MLmodel").write_text(json.dumps({"flavors": {"python_function": flavor}}), encoding="utf-8")
    return folder


def table(base: Path) -> tuple[Path, dict[str, Body]]:
    """Return the folder of a model of a table, and a request for one row for each server."""
    generator = np.random.default_rng(0)
    cells = generator.normal(size=(600, 5))
    target = cells @ [1, 2, 0, -1, 0.5] + 0.3 * generator.normal(size=600)
    names = list("abcde")
    lines = [
        ",".join([*names, "y"]),
        *(",".join(f"{number:.6g}" for number in row) for row in np.column_stack([cells, target])),
    ]
    (base / "rows.csv").write_text("\n".join([*lines, ""]))
    data = (
        "data=tabular",
        f"data.path={base / 'rows.csv'}",
        "data.target=y",
        "data.kind=real",
        "metric=[nll]",
    )
    folder = train(base, "table", *data, "encoder=[mlp]", "density_head=gaussian", *NETWORK)
    row = cells[0].tolist()
    split = {"dataframe_split": {"columns": names, "data": [row]}}
    return folder, {
        "exported": Body("/predict", json.dumps({"inputs": [row], "interval": 0.9}).encode()),
        "mlflow": Body("/invocations", json.dumps(split).encode()),
    }


def clouds(base: Path) -> tuple[Path, dict[str, Body]]:
    """Return the folder of a classifier of clouds, and a request for a cloud of POINTS points for each server."""
    row = ROWS["point_cloud_folder"][0]
    home = base / "clouds"
    home.mkdir()
    assert row.write is not None
    settings = {**row.write(home), **row.config}
    options = [f"data.{key}={str(value).replace(' ', '')}" for key, value in settings.items()]
    parts = ("density_head=categorical", "encoder=[bps,mlp]", "metric=[accuracy]")
    folder = train(base, "cloud", "data=point_cloud_folder", *options, *parts, *NETWORK)
    cloud = np.random.default_rng(0).normal(size=(1, POINTS, 3)).astype(np.float32)
    stream = BytesIO()
    np.save(stream, cloud)
    head = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {POINTS}\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    )
    content = base64.b64encode(head.encode() + cloud.tobytes()).decode()
    return folder, {
        "exported": Body("/predict", stream.getvalue(), "application/octet-stream"),
        "mlflow": Body(
            "/invocations", json.dumps({"dataframe_records": [{"base64": content, "name": "a.ply"}]}).encode()
        ),
    }


def measure_model(title: str, folder: Path, bodies: dict[str, Body]) -> list[dict[str, str]]:
    """Return the table rows of a model: a title, the server, and the cells."""
    loads: dict[str, list[Load]] = {name: [] for name in bodies}
    firsts: dict[str, list[float]] = {name: [] for name in bodies}
    statuses: Counter[int] = Counter()
    for number in range(ROUNDS):
        with start_service(folder / "exported") as port:
            firsts["exported"].append(first_wait(port, bodies["exported"]))
            loads["exported"].append(measure(port, bodies["exported"], REQUESTS["exported"]))
            if number == 0:
                statuses = send_malformed(port, bodies["exported"], folder)
        with start_server(folder / "mlflow") as (port, _):
            firsts["mlflow"].append(first_wait(port, bodies["mlflow"]))
            loads["mlflow"].append(measure(port, bodies["mlflow"], REQUESTS["mlflow"]))
    lines = []
    for name, rounds in loads.items():
        middle, last = ([float(np.percentile(load.waits, share)) for load in rounds] for share in (50, 99))
        lines.append(
            {
                "request": title,
                "server": NAMES[name],
                "requests per second": median_and_range([load.rate for load in rounds]),
                "p50, ms": f"{median(middle):.3g}",
                "p99, ms": median_and_range(last),
                "first, ms": median_and_range(firsts[name]),
                "processor, ms": f"{median(load.processor for load in rounds):.2g}",
                "statuses": ", ".join(f"{count} × {status}" for status, count in sorted(statuses.items()))
                if name == "exported"
                else "",
            }
        )
    return lines


NAMES = {"exported": "exported service", "mlflow": "`mlflow models serve`"}
MODELS = {
    "table": ("one row of a table", table),
    "clouds": (f"one cloud of {POINTS:,} points", clouds),
}
TABLE = Path(__file__).with_suffix(".csv")


def main() -> None:
    names = sys.argv[1:] or list(MODELS)
    lines: list[dict[str, str]] = []
    if TABLE.exists():
        with TABLE.open(encoding="utf-8", newline="") as stream:
            lines = [
                line
                for line in csv.DictReader(stream)
                if line["request"] not in {MODELS[name][0] for name in names}
            ]
    for name in names:
        title, prepare = MODELS[name]
        with TemporaryDirectory() as base:
            folder, bodies = prepare(Path(base))
            lines += measure_model(title, folder, bodies)
    lines.sort(key=lambda line: [title for title, _ in MODELS.values()].index(line["request"]))
    with TABLE.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, list(lines[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(lines)
    write(lines)


def write(lines: Sequence[dict[str, str]]) -> None:
    """Write the page."""
    columns = [name for name in lines[0] if name != "statuses"]
    refusals = "; ".join(f"{line['request']}: {line['statuses']}" for line in lines if line["statuses"])
    text = (
        "# Serving: requests per second\n\n"
        "This page says how many requests per second the web service of an exported model answers (`serve.py`, "
        "[docs/export.md](../../docs/export.md)), and how long a request waits. `mlflow models serve` serves the same "
        "trained model, and the client runs on the same machine.\n\n"
        f"The client sends requests over {CONNECTIONS} connections that stay open. Each request holds one input. The "
        "answer for a row of the table holds the median, a central interval and the entropy; the answer for a cloud "
        "holds the probabilities of the classes. The cloud is sent as a binary file: `.npy` to the exported service, "
        f"and PLY in JSON to MLflow's server. A round has {REQUESTS['exported']:,} requests to the exported service "
        f"and {REQUESTS['mlflow']} to MLflow's server. Both are started anew for each of {ROUNDS} rounds, one after "
        "the other. `p50` and `p99` are percentiles of the response time. `first` is the response time of the first "
        "request after the start. `processor` is the server's processor time for one request. Numbers are medians "
        "over the rounds, with the smallest and the largest one in brackets. The models were trained on generated "
        "data.\n\n"
        f"| {' | '.join(columns)} |\n|{'---|' * len(columns)}\n"
        + "".join(f"| {' | '.join(line[name] for name in columns)} |\n" for line in lines)
        + "\nThe project requires at least 400 requests per second for the table and 150 for clouds, p99 of at most "
        "50 ms, and at most 200 ms for the first request.\n\n"
        f"The script sends {MALFORMED:,} malformed requests to the exported service of each model, among them JSON of "
        f"up to 100,000 nested brackets. The answers were (number × HTTP status): {refusals}. Status 400 is an "
        "error message. Status 200, a prediction, would be right only for bytes that were changed at random and "
        "still are a valid request. No answer held a path of the server, and the service answered a good request "
        "afterwards.\n\n"
        f"{machine('onnxruntime', 'fastapi', 'uvicorn', 'mlflow', 'numpy')} "
        "Command: `python -m benchmarks.framework.serving`.\n"
    )
    write_page(__file__, text)


if __name__ == "__main__":
    main()
