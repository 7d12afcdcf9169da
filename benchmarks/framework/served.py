"""Time the first and later requests to a served model.

    python -m benchmarks.framework.served

The script trains a small model on generated data for each data set. It starts the server that `mlflow models serve`
runs, sends one request and ten more, and stops the server; this is repeated several times. It writes served.md beside
this file.
"""

import base64
import contextlib
import http.client
import json
import os
import shlex
import shutil
import signal
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from mlflow.pyfunc.scoring_server import get_cmd

from benchmarks.commands import carry_out
from benchmarks.pages import machine, write_page
from tests.test_loaded import QUICK

STARTS, LATER = 5, 10
KINDS = {
    "tabular": ("tabular", ("density_head=categorical", "encoder=[mlp]", "metric=[accuracy]")),
    "images_with_angles": (
        "images_with_angles",
        ("density_head=von_mises", "encoder=[mlp]", "metric=[angular_deviation]"),
    ),
    "point_cloud_folder": (
        "labelled_clouds",
        ("density_head=categorical", "encoder=[bps,mlp]", "metric=[accuracy]"),
    ),
}
"""Data sets, each with the folder of its plugin and the settings of the model."""
WITHOUT_WARM_UP = (
    "The server of a model makes a few predictions before it accepts requests, so that the first request is not "
    "slow. Without this warm-up the first request took 52.5, 94.2 and 508.0 ms for the three data sets, in the order "
    "of the rows of the table. Later requests took 14.3, 15.1 and 15.7 ms. The ratios were 3.7, 6.2 and 32.4. These "
    "numbers were measured on 2026-11-25 with the same command on the last commit without the warm-up. Other work "
    "ran on the machine at the same time."
)


def train_model(kind: str, base: Path) -> tuple[Path, str]:
    """Train a model on a data set's first row; return its folder for MLflow and a request with one file, as JSON."""
    plugin, parts = KINDS[kind]
    row = import_module(f"plugins.data.{plugin}.rows").ROWS[kind][0]
    home, own, run, model = (base / name for name in ("home", "own", "run", "model"))
    for folder in (home, own, model):
        folder.mkdir(parents=True)
    settings = {**row.write(home), **row.config}
    options = [f"data.{key}={str(value).replace(' ', '')}" for key, value in settings.items()]
    arguments = [f"data={kind}", *options, *parts, *QUICK, f"hydra.run.dir={run}"]
    carry_out([sys.executable, "-m", "framework", *arguments])
    shutil.copy(run / "checkpoints" / "model.ckpt", model / "model.ckpt")
    flavor = {"loader_module": "framework.deployment.served", "data": "model.ckpt", "python_version": "3.11"}
    (model / "MLmodel").write_text(json.dumps({"flavors": {"python_function": flavor}}), encoding="utf-8")
    file = sorted(row.files(own))[0]
    content = base64.b64encode(file.read_bytes()).decode()
    return model, json.dumps({"dataframe_records": [{"base64": content, "name": file.name}]})


def free_port() -> int:
    """Return a port of the loopback device that no program uses at this moment."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return free.getsockname()[1]


@contextlib.contextmanager
def run_server(
    command: Sequence[str],
    port: int,
    folder: Path,
    environment: Mapping[str, str] | None = None,
    end: signal.Signals = signal.SIGTERM,
    quiet: bool = False,
) -> Iterator[float]:
    """Run a server in the block, and yield the seconds from its start until it accepted connections."""
    output = subprocess.DEVNULL if quiet else None
    begin = time.perf_counter()
    process = subprocess.Popen(
        command, env=environment, cwd=folder, stdout=output, stderr=output, start_new_session=True
    )
    try:
        while True:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5):
                break
            assert process.poll() is None, "The server ended before it accepted a connection."
            time.sleep(0.02)
        yield time.perf_counter() - begin
    finally:
        os.killpg(process.pid, end)
        process.wait()


@contextlib.contextmanager
def start_server(model: Path) -> Iterator[tuple[int, float]]:
    """Start MLflow's server on the loopback device, and yield its port and the seconds that its start took."""
    port = free_port()
    line, environment = get_cmd(str(model), port=port, host="127.0.0.1")  # pyright: ignore[reportArgumentType]
    with run_server(shlex.split(line), port, model, environment, signal.SIGKILL, quiet=True) as seconds:
        yield port, seconds


def response_time(port: int, body: str) -> float:
    """Return the response time of one request, seconds."""
    start = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=100)
    connection.request("POST", "/invocations", body, {"Content-Type": "application/json"})
    response = connection.getresponse()
    text = response.read()
    connection.close()
    assert response.status == 200, text
    return time.perf_counter() - start


def main() -> None:
    lines = []
    for kind in KINDS:
        with TemporaryDirectory() as folder:
            model, body = train_model(kind, Path(folder))
            starts, first, later = [], [], []
            for _ in range(STARTS):
                with start_server(model) as (port, start):
                    starts.append(start)
                    first.append(response_time(port, body))
                    later.append(statistics.median(response_time(port, body) for _ in range(LATER)))
        start, first_seconds, later_seconds = (statistics.median(times) for times in (starts, first, later))
        lines.append(
            f"| {kind} | {start:.1f} | {1000 * first_seconds:.1f} | {1000 * later_seconds:.1f} | "
            f"{first_seconds / later_seconds:.1f} |"
        )
    head = (
        "# Served models: the first request against later ones\n\n"
        "This page compares the time that a served model needs for its first request and for later requests. The "
        "server is the one that `mlflow models serve` starts. A slow first request would delay the first user after "
        "every start.\n\n"
        f"To measure the response times, the server of `mlflow models serve` is started {STARTS} times for each data "
        "set, with a small model that was trained on generated data. Each request sends one file. The column `start` "
        "is the time from the start of the server until it accepts connections. `first request` is the response time "
        f"of the first request. `later requests` is the median response time of {LATER} further requests. All three "
        f"are medians over the {STARTS} starts. `ratio` is the time of the first request divided by the time of the "
        f"later requests.\n\n"
        "| data | start, s | first request, ms | later requests, ms | ratio |\n|---|---|---|---|---|\n"
    )
    where = f"{machine('torch', 'mlflow', 'uvicorn')} Command: `python -m benchmarks.framework.served`."
    text = f"{head}{chr(10).join(lines)}\n\n{WITHOUT_WARM_UP}\n\n{where}\n"
    write_page(__file__, text)


if __name__ == "__main__":
    main()
