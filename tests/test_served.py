"""Served models, which respond to every request with a prediction or one error message, within limits of time and
memory."""

import asyncio
import base64
import http.client
import json
import os
import shlex
import signal
import socket
import subprocess
import time
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from io import BytesIO
from pathlib import Path
from typing import Any

import pandas as pd
import pytest
from PIL import Image

from framework.deployment import request_bodies as bounds
from framework.deployment.request_bounds import BoundedApp
from framework.deployment.served import _load_pyfunc
from tests.conftest import Forks, command, importing_mlflow
from tests.test_loaded import KINDS, QUICK

with importing_mlflow():
    from mlflow.pyfunc import load_model, scoring_server

SECONDS = 6
"""Limit of the time of one request, seconds."""
ROW = {"number": 3.0, "square": 9.0}
TABULAR, IMAGES = "tabular", "images_with_angles"
JSON, CSV = "application/json", "text/csv"


@dataclass
class Server:
    """A server of MLflow on the loopback device.

    Attributes:
        model: folder of the model.
        temporary: its folder for temporary files, and nobody else's.
    """

    process: subprocess.Popen[bytes]
    port: int
    model: Path
    temporary: Path
    log: Path

    def post(
        self, body: bytes | str, kind: str | None = JSON, more: Mapping[str, str] | None = None
    ) -> tuple[int, str]:
        """Return status and text of the answer."""
        connection = http.client.HTTPConnection("127.0.0.1", self.port, timeout=60)
        try:
            connection.request(
                "POST", "/invocations", body, {**({"Content-Type": kind} if kind else {}), **(more or {})}
            )
            answer = connection.getresponse()
            return answer.status, answer.read().decode()
        finally:
            connection.close()

    def peak(self) -> int:
        """Return the bytes that the process held at most."""
        status = Path(f"/proc/{self.process.pid}/status").read_text(encoding="ascii")
        return 1024 * int(status.split("VmHWM:")[1].split()[0])

    def refuses(self, body: bytes | str, kind: str | None = JSON, *, names: str = "") -> None:
        """Check that a request is refused with one sentence that tells nothing of the server's machine."""
        begun = time.monotonic()
        code, text = self.post(body, kind)
        seconds = time.monotonic() - begun
        assert code in (400, 413, 415), text
        found = json.loads(text)
        assert set(found) == {"error_code", "message"}
        sentence = found["message"]
        assert names in sentence
        assert len(sentence) < 1500
        assert sentence.isprintable()
        for hidden in (str(self.temporary), str(self.model), "/tmp", "site-packages", "Traceback", ".py"):
            assert hidden not in sentence
        assert seconds < 5, f"{seconds:.1f} s until {sentence}"


def started(kind: str, forks: Forks, site: Path, base: Path) -> Server:
    """Train a small model, and begin to serve it by the command of `mlflow models serve`."""
    home, model, temporary = base / "home", base / "model", base / "temporary"
    for folder in (home, model, temporary):
        folder.mkdir(parents=True)
    name, *parts = KINDS[kind]
    row = next(one for one in import_module(f"plugins.data.{kind}.rows").ROWS[kind] if one.name == name)
    assert row.write is not None
    settings = {**row.write(home), **row.config}
    options = [f"data.{key}={str(value).replace(' ', '')}" for key, value in settings.items()]
    done = command(forks, site, base)(f"data={kind}", *options, *parts, *QUICK)
    assert done.code == 0, done.out
    (done.folder / "checkpoints" / "model.ckpt").rename(model / "model.ckpt")
    flavor = {"loader_module": "framework.deployment.served", "data": "model.ckpt", "python_version": "3.11"}
    (model / "MLmodel").write_text(json.dumps({"flavors": {"python_function": flavor}}), encoding="utf-8")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    line, environment = scoring_server.get_cmd(str(model), port=port, host="127.0.0.1", timeout=SECONDS)
    environment |= {"TMPDIR": str(temporary), "OMP_NUM_THREADS": "1"}
    with (base / "log.txt").open("wb") as log:
        process = subprocess.Popen(
            shlex.split(line), env=environment, cwd=base, stdout=log, stderr=log, start_new_session=True
        )
    return Server(process, port, model, temporary, base / "log.txt")


@pytest.fixture(scope="module")
def servers(
    forks: Forks, stranger_site: Path, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[str, Server]]:
    """Start a server for rows and one for images at the same time."""
    found: dict[str, Server] = {}
    try:
        for kind in (TABULAR, IMAGES):
            found[kind] = started(kind, forks, stranger_site, tmp_path_factory.mktemp(kind))
        deadline = time.monotonic() + 120
        for server in found.values():
            while True:
                try:
                    with socket.create_connection(("127.0.0.1", server.port), timeout=5):
                        break
                except OSError:
                    assert server.process.poll() is None, server.log.read_text(encoding="utf-8")
                    assert time.monotonic() < deadline
                    time.sleep(0.05)
        yield found
    finally:
        for server in found.values():
            os.killpg(server.process.pid, signal.SIGKILL)
            server.process.wait()


def png(side: int = 8) -> bytes:
    """Return an image of one colour."""
    content = BytesIO()
    Image.new("RGB", (side, side), (90, 120, 150)).save(content, "PNG")
    return content.getvalue()


def bomb() -> bytes:
    """Return a PNG whose 0.6 MB decompress to 0.6 GB of zeros."""
    side = 25_000

    def chunk(kind: bytes, data: bytes) -> bytes:
        return len(data).to_bytes(4) + kind + data + zlib.crc32(kind + data).to_bytes(4)

    lines = 100  # compressed once, and repeated
    packer = zlib.compressobj(9, wbits=-15)
    part = packer.compress(bytes(lines * (side + 1))) + packer.flush(zlib.Z_FULL_FLUSH)
    checksum = (side * (side + 1) % 65521) << 16 | 1  # Adler-32 of zeros
    data = b"\x78\xda" + part * (side // lines) + packer.flush() + checksum.to_bytes(4)
    header = side.to_bytes(4) + side.to_bytes(4) + bytes([8, 0, 0, 0, 0])
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def text(content: bytes) -> str:
    return base64.b64encode(content).decode()


def forms(rows: list[dict[str, Any]]) -> dict[str, tuple[str, str]]:
    """Return the body and content type of the same rows in each form that MLflow reads."""
    frame = pd.DataFrame(rows)
    split = {"columns": list(frame), "data": frame.to_numpy(object).tolist()}
    return {
        "dataframe_split": (json.dumps({"dataframe_split": split}), JSON),
        "dataframe_records": (json.dumps({"dataframe_records": rows, "params": {}}), JSON),
        "instances": (json.dumps({"instances": frame.to_numpy(object).tolist()}), JSON),
        "inputs": (json.dumps({"inputs": frame.to_numpy(object).tolist()}), JSON),
        "csv": (frame.to_csv(index=False), 'Text/CSV; charset="UTF-8"'),
    }


@pytest.mark.slow
def test_every_form_is_answered_as_in_a_notebook(servers: dict[str, Server]) -> None:
    """Rows and files are read in each form that MLflow accepts, with any spelling of the content type."""
    for kind, row in ((TABULAR, ROW), (IMAGES, {"base64": text(png()), "name": "my.png"})):
        wanted = load_model(str(servers[kind].model)).predict(pd.DataFrame([row, row]))
        for form, (body, content_type) in forms([row, row]).items():
            if kind == IMAGES and form in ("instances", "inputs"):
                body = json.dumps({form: [row["base64"]] * 2})
            code, answer = servers[kind].post(body, content_type)
            assert code == 200, (form, answer)
            found = pd.DataFrame(json.loads(answer)["predictions"])
            pd.testing.assert_frame_equal(found, wanted, rtol=1e-6, check_dtype=False)


@pytest.mark.slow
def test_made_up_samples_are_answered_before_the_server_listens(servers: dict[str, Server]) -> None:
    """Each kind of model predicts its own sample request, so that the first request needs no imports and no
    compilation."""
    for server in servers.values():
        served = _load_pyfunc(str(server.model / "model.ckpt"))
        samples = list(served.sample_requests())
        assert samples
        for sample in samples:
            assert len(served.predict_table(sample)) == len(served.predict_table(sample)) > 0
    calls: list[tuple[str, bytes]] = []

    async def app(scope: Any, receive: Any, send: Any) -> None:
        body = (await receive())["body"] if scope["type"] == "http" else b""
        calls.append((scope["type"], body))
        if scope["type"] == "http":
            await send({"type": "http.response.start", "status": 200, "headers": []})
            await send({"type": "http.response.body", "body": b"{}"})

    async def nothing(*message: Any) -> None:
        pass

    sample = b'{"inputs": [1]}'
    asyncio.run(BoundedApp(app, 5.0, [sample])({"type": "lifespan"}, nothing, nothing))
    assert calls == [("http", sample), ("lifespan", b"")]


def faults(row: dict[str, Any]) -> Iterator[tuple[str, bytes | str, str | None]]:
    """Yield the name, body and content type of requests that have no prediction."""
    deep = "[" * 5000 + "]" * 5000
    good, wide = json.dumps(row), json.dumps([row] * 3)
    split = {"columns": list(row), "data": [list(row.values())]}
    for form in bounds.FORMS:
        whole = json.dumps({form: {"dataframe_split": split, "dataframe_records": [row]}.get(form, 3)})
        for name, value in {
            "deep": deep,
            "deep dictionaries": '{"a":' * 5000 + "1" + "}" * 5000,
            "deep in a text that ends": '["\\\\",' + deep + "]",
            "nothing": "null",
            "empty list": "[]",
            "empty dictionary": "{}",
            "empty text": '""',
            "text": '"/etc/hostname"',
            "number": "3",
            "mixed": f'["/etc/hostname", {good}]',
            "ragged": "[[1, 2], [3]]",
            "huge integer": "[[" + "9" * 5000 + ", 1]]",
            "large integer": "[[" + "9" * 4000 + ", 1]]",
            "NaN": "[[NaN, 1]]",
            "infinite": "[[1e999, 1e999]]",
            "twice": f'{{"a": {wide}, "a": {wide}}}',
            "wrong columns": '[{"nunber": 1, "sqare": 2}]',
            "surrogate": '["\\ud800"]',
        }.items():
            yield f"{name} in {form}", f'{{"{form}": {value}}}', JSON
        yield f"cut {form}", whole[:-1], JSON
        yield f"unknown key beside {form}", whole[:-1] + ', "seed": 1}', JSON
        yield f"parameters beside {form}", whole[:-1] + ', "params": {"seed": 1}}', JSON
        yield f"{form} twice", whole[:-1] + ", " + whole[1:], JSON
        yield f"compressed {form}", zlib.compress(whole.encode()), JSON
        for kind in (
            "application/json; charset=utf-16",
            "application/vnd.apache.parquet",
            "text/plain",
            "",
            None,
        ):
            yield f"{form} as {kind}", whole, kind
    for name, value in {
        "short row": {**split, "data": [[1]]},
        "columns twice": {**split, "columns": [next(iter(row))] * len(row)},
        "no columns": {"data": [[1, 2]]},
        "column numbers": {**split, "columns": [1, 2]},
        "index": {**split, "index": [1, 2, 3]},
    }.items():
        yield name, json.dumps({"dataframe_split": value}), JSON
    yield "unlike records", json.dumps({"dataframe_records": [{str(n): n} for n in range(2000)]}), JSON
    yield "two forms", json.dumps({"inputs": [1], "instances": [1]}), JSON
    yield "chat", json.dumps({"messages": [{"role": "user", "content": "hello"}]}), JSON
    for name, body in {
        "empty": b"",
        "blank": b" \n ",
        "no UTF-8": b"\xff\xfe\x00",
        "list": b"[1, 2]",
        "brackets": b"[" * 2**20,
        "many lists": b'{"inputs":[' + b"[]," * 2**21 + b"[]]}",
        "many texts": b'{"inputs":[' + b'"",' * 2**22 + b'""]}',
        "quotes": b'"' * 2**24,
        "backslashes": b'{"inputs":"' + b"\\\\" * 2**23,
    }.items():
        yield name, body, JSON
    for name, body in {
        "no rows": "number,square\n",
        "wide and long": "a" + ",a" * 2000 + "\n" + "1\n" * 2000,
        "longer row": "number,square\n1,2\n1,2,3,4\n",
        "words": "number,square\none,two\n",
        "NUL": "number,square\n1,\0\n",
        "no numbers": "number,square\nnan,inf\n",
        "open quote": 'number,square\n1,"2\n',
        "another's columns": "x,y\n1,2\n",
        "empty": "",
        "lines": "a\n" * (bounds.MOST_ROWS + 1),
    }.items():
        yield f"{name}, CSV", body, CSV


@pytest.mark.slow
def test_no_form_with_any_fault_gets_more_than_a_sentence(servers: dict[str, Server]) -> None:
    """Any faulty body gets the status 400, 413 or 415 within 5 s and with less than 1 GB of additional memory."""
    for kind, row in ((TABULAR, ROW), (IMAGES, {"base64": text(png()), "name": "my.png"})):
        server, count = servers[kind], 0
        before = server.peak()
        for name, body, content_type in faults(row):
            # a number is a row's for neither; rows of unlike length are filled by nobody
            try:
                server.refuses(body, content_type)
            except AssertionError as error:
                raise AssertionError(f"{kind}: {name}: {error}") from error
            count += 1
        assert count > 100
        assert server.peak() < before + 2**30
        assert server.post(*forms([row])["dataframe_split"])[0] == 200


@pytest.mark.slow
def test_contents_of_files_are_bounded_and_named_by_row(servers: dict[str, Server]) -> None:
    """The message contains the client's name of the file, not the server's; no file of the server is read."""
    server = servers[IMAGES]
    canary = server.model.parent / "canary.png"  # a file that could be predicted for
    canary.write_bytes(png())
    before = server.peak()
    good = {"base64": text(png()), "name": "good.png"}
    contents = {
        "no image": (text(b"nothing"), "my cat.png"),
        "bomb": (text(bomb()), "bomb.png"),
        "cut": (text(png(64)[:60]), "cut.png"),
        "path": (str(canary), "canary.png"),
        "address": (f"http://127.0.0.1:{server.port}/ping", "a.png"),
        "number": (7, "a.png"),
        "empty": ("", "empty.png"),
        "list": (["a"], "a.png"),
        "large": ("A" * (bounds.MOST_CONTENT // 3 * 4 + 8), "large.png"),
    }
    for content, name in contents.values():
        rows = [good, {"base64": content, "name": name}]
        bodies = forms(rows)
        for form in ("dataframe_split", "dataframe_records"):
            server.refuses(bodies[form][0], names="row 1")
    for name in (
        "../../escaped.png",
        str(canary),
        "é" * 300 + ".png",
        "\0\x1b[2J.png",
        ".png",
    ):
        status, answer = server.post(json.dumps({"dataframe_records": [{**good, "name": name}]}))
        assert status == 200, answer
        server.refuses(json.dumps({"dataframe_records": [good, {"base64": text(b"x"), "name": name}]}))
    for value in (str(canary), [str(canary)], [[str(canary)]], {"base64": str(canary)}, [str(canary), 1]):
        for form in ("inputs", "instances"):
            server.refuses(json.dumps({form: value}))
    many = [good] * (bounds.MOST_FILES + 1)
    server.refuses(json.dumps({"dataframe_records": many}), names=f"{len(many)} files")
    assert server.peak() < before + 2**30
    left = [path for path in server.temporary.rglob("*") if path.name.startswith("tmp")]
    assert not left, "a request leaves nothing behind"


@pytest.mark.slow
def test_the_bound_of_size_and_time_holds_before_a_body_is_there(servers: dict[str, Server]) -> None:
    """Send a Content-Length that is too large, false or missing, and bodies that are endless or slow."""
    server = servers[TABULAR]
    head = "POST /invocations HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    body = forms([ROW])["dataframe_split"][0]

    def raw(content: bytes, more: bytes = b"") -> bytes:
        """Return what the server says until it closes the connection; `more` is sent again and again."""
        answer = b""
        with socket.create_connection(("127.0.0.1", server.port), timeout=30) as connection:
            connection.sendall(content)
            try:
                for _ in range(200 if more else 0):
                    connection.sendall(more)
            except OSError:
                pass  # the server has closed the connection
            try:
                for part in iter(partial(connection.recv, 2**16), b""):
                    answer += part
            except ConnectionResetError:
                pass
        return answer

    before = server.peak()
    large = raw(f"{head}Content-Length: {bounds.MOST_BODY + 1}\r\n\r\n".encode())
    assert large.startswith(b"HTTP/1.1 413 ")
    assert b"Send fewer rows" in large
    chunk = b"100000\r\n" + b" " * 2**20 + b"\r\n"
    endless = raw(f"{head}Transfer-Encoding: chunked\r\n\r\n".encode(), chunk)
    assert endless == b"" or endless.startswith(b"HTTP/1.1 413 ")
    assert server.peak() < before + 2**29
    for length in ("-1", "x", "1e3", "9" * 30):
        assert raw(f"{head}Content-Length: {length}\r\n\r\n".encode()).split(b" ")[1] in (b"400", b"413")
    # a client that reads nothing before it has sent everything
    status, answer = server.post(b" " * (2 * bounds.MOST_BODY))
    assert status == 413
    assert "Send fewer rows" in answer
    assert server.peak() < before + 2**29
    # shorter than the body, which is cut there
    assert raw(f"{head}Connection: close\r\nContent-Length: 9\r\n\r\n{body}".encode()).startswith(
        b"HTTP/1.1 400 "
    )
    begun = time.monotonic()
    slow = raw(f"{head}Content-Length: {len(body) + 1}\r\n\r\n{body}".encode())
    assert slow.startswith(b"HTTP/1.1 408 ")
    assert b"--timeout" in slow
    assert SECONDS - 1 < time.monotonic() - begun < SECONDS + 5
    assert server.post(body)[0] == 200
