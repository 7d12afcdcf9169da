"""Time the first and later requests to a served model.

    python -m benchmarks.framework.served

Starts the server that `mlflow models serve` runs, asks it once and ten times more, and ends it; several starts of each
model, which are trained here first on small generated data. Writes served.md beside this file.
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
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory

from mlflow.pyfunc.scoring_server import get_cmd

from benchmarks.commands import carry_out
from benchmarks.pages import machine, write_page

STARTS, LATER = 5, 10
QUICK = (
    "encoder.mlp.widths=[8]",
    "trainer.max_epochs=1",
    "batch_size=8",
    "pictures=false",
    "logger=none",
    "threads=1",
)
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
"""Data set → folder of its plugin, settings of the model."""


def trained(kind: str, base: Path) -> tuple[Path, str]:
    """Train a model of a data set's first contract row; its folder for MLflow, and a request with one file."""
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


@contextlib.contextmanager
def serving(model: Path) -> Iterator[tuple[int, float]]:
    """A server on the loopback device: its port, and the seconds until it listened."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    line, environment = get_cmd(str(model), port=port, host="127.0.0.1")  # pyright: ignore[reportArgumentType]
    quiet = subprocess.DEVNULL
    begun = time.perf_counter()
    process = subprocess.Popen(
        shlex.split(line), env=environment, cwd=model, stdout=quiet, stderr=quiet, start_new_session=True
    )
    try:
        while True:
            with contextlib.suppress(OSError), socket.create_connection(("127.0.0.1", port), timeout=5):
                break
            assert process.poll() is None, "the server has ended"
            time.sleep(0.02)
        yield port, time.perf_counter() - begun
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()


def seconds(port: int, body: str) -> float:
    """What one request takes."""
    begun = time.perf_counter()
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=100)
    connection.request("POST", "/invocations", body, {"Content-Type": "application/json"})
    answer = connection.getresponse()
    text = answer.read()
    connection.close()
    assert answer.status == 200, text
    return time.perf_counter() - begun


def main() -> None:
    lines = []
    for kind in KINDS:
        with TemporaryDirectory() as folder:
            model, body = trained(kind, Path(folder))
            starts, first, later = [], [], []
            for _ in range(STARTS):
                with serving(model) as (port, start):
                    starts.append(start)
                    first.append(seconds(port, body))
                    later.append(statistics.median(seconds(port, body) for _ in range(LATER)))
        start, one, others = (statistics.median(times) for times in (starts, first, later))
        lines.append(
            f"| {kind} | {start:.1f} | {1000 * one:.1f} | {1000 * others:.1f} | {one / others:.1f} |"
        )
    head = (
        "# Served models: the first request against later ones\n\n"
        f"`python -m benchmarks.framework.served`: one file a request; medians of {STARTS} starts of the server, of "
        f"later requests the median of {LATER} in each.\n\n"
        "| data | s until it listens | first, ms | later, ms | ratio |\n|---|---|---|---|---|\n"
    )
    text = f"{head}{chr(10).join(lines)}\n\n{machine('torch', 'mlflow', 'uvicorn')}\n"
    write_page(__file__, text)


if __name__ == "__main__":
    main()
