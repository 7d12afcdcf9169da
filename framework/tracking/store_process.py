"""Access to the store from a separate process, so that the process that trains never imports MLflow.

Requests and responses are lines of JSON. The process ends when its input ends, that is, when the input is closed or the
requesting process has died.
"""

import json
import logging
import os
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any, BinaryIO, final

from pydantic import TypeAdapter

from framework.errors import DataError
from framework.storage.imports import without_collection
from framework.tracking.run_info import RunInfo
from framework.tracking.sender import Record, Store, reason

_log = logging.getLogger(__name__)
_COMMAND = (sys.executable, "-P", "-m", __name__)
_ENDING = 5.0  # seconds in which the process must end by itself


class StoreAway(Exception):
    """Error for a store that is locked, full or cannot be reached, or for a store process that has ended."""


@final
class StoreProcess:
    """Function object of type `sender.OpenStore` that opens runs in MLflow from a separate process.

    The first call starts the process, unless `start` has started it.
    """

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self, folder: Path, info: RunInfo) -> Store:
        self.start()
        return _DistantStore(self, folder, info)

    def start(self) -> None:
        """Start the process, which imports MLflow at once; do nothing if the process runs already."""
        if self._process is not None and self._process.poll() is not None:
            self.end()
        if self._process is None:
            # a separate session, because Ctrl-C is meant for the training, which then ends this process
            self._process = subprocess.Popen(
                _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )

    def ask(self, **request: Any) -> Mapping[str, Any]:
        """Send a request to the process, log the log messages of the process, and return its response.

        Raises:
            DataError: A file may not be sent to the store.
            StoreAway: The store failed, or the process has ended.
        """
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        line = b""
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps(request).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        no_response = {"error": "the process that sends to the store has ended", "refused": False}
        response: dict[str, Any] = json.loads(line) if line else no_response
        for level, text in response.get("said", ()):
            _log.log(level, "%s", text)
        if "error" in response:
            raise DataError(response["error"]) if response["refused"] else StoreAway(response["error"])
        return response

    def end(self, *, at_once: bool = False) -> None:
        """End the process after its current request or, with `at_once`, immediately."""
        process, self._process = self._process, None
        if process is None:
            return
        assert process.stdin is not None and process.stdout is not None
        if at_once:
            process.kill()
        with suppress(OSError):  # the process has ended already, before it read the whole request
            process.stdin.close()
        try:
            process.wait(_ENDING)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        process.stdout.close()


_early: list[StoreProcess] = []
"""The process that `started_early` has started and that no tracker has taken yet, or nothing."""


@contextmanager
def started_early() -> Iterator[None]:
    """Start the process that writes to MLflow's store, for a tracker that is opened inside the block.

    The process imports MLflow on a second core while the command, on one core, imports PyTorch and reads its data. So
    the import takes no time from the training, and a short run need not wait for the import at its end. If no tracker
    has taken the process (`take_process`) when the block ends, the process is ended.
    """
    process = StoreProcess()
    process.start()
    _early.append(process)
    try:
        yield
    finally:
        if process in _early:
            _early.remove(process)
            process.end(at_once=True)


def take_process() -> StoreProcess:
    """Return the process of `started_early`; if there is none, return a new one, which starts at its first request."""
    return _early.pop() if _early else StoreProcess()


@final
class _DistantStore(Store):
    def __init__(self, process: StoreProcess, folder: Path, info: RunInfo) -> None:
        self._process = process
        response = process.ask(open=str(folder), info=asdict(info))
        # JSON turns tuples into lists
        owed = tuple((path, place) for path, place in response["identity"]["owed"])
        self.identity, self.replay = {**response["identity"], "owed": owed}, response["replay"]

    def send(self, batch: Sequence[Record]) -> None:
        self.replay = self._process.ask(send=batch)["replay"]

    def send_file(self, path: str, place: str) -> None:
        self._process.ask(send_file=path, place=place)


class _CollectingHandler(logging.Handler):
    """Log handler that collects the messages for the next response."""

    def __init__(self) -> None:
        logging.Handler.__init__(self, logging.WARNING)
        self.lines: list[tuple[int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((record.levelno, record.getMessage()))


def serve(requests: BinaryIO, responses: BinaryIO) -> None:
    """Read requests and write responses until the input ends."""
    log_handler = _CollectingHandler()
    logging.getLogger().addHandler(log_handler)
    store: Store | None = None
    for line in requests:
        request = json.loads(line)
        try:
            if "open" in request:
                from framework.tracking.mlflow_store import MlflowStore

                info = TypeAdapter(RunInfo).validate_python(request["info"])
                store = MlflowStore(Path(request["open"]), info)
            assert store is not None, "the first request must open a run"
            if "send" in request:
                store.send(request["send"])
            elif "send_file" in request:
                store.send_file(request["send_file"], request["place"])
            response: dict[str, Any] = {"identity": dict(store.identity), "replay": dict(store.replay)}
        except Exception as error:
            refused = isinstance(error, DataError)
            response = {"error": str(error) if refused else reason(error), "refused": refused}
        response["said"], log_handler.lines = log_handler.lines, []
        try:
            responses.write(json.dumps(response).encode() + b"\n")
            responses.flush()
        except BrokenPipeError:  # the requesting process has died
            return


def main() -> None:
    """Handle requests from standard input; redirect the output of MLflow to standard error, away from the responses."""
    responses = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    # MLflow works without these packages, whose import takes a third of the time, as long as it reads no data
    sys.modules.update(dict.fromkeys(("numpy", "pandas", "pyarrow")))  # type: ignore[arg-type]
    with without_collection(), suppress(Exception):  # `serve` raises the same error, and reports it
        import_module("framework.tracking.mlflow_store")
    serve(sys.stdin.buffer, responses)
    sys.stderr.flush()
    os._exit(0)  # everything is stored, and Python would take a third of a second to release its objects


if __name__ == "__main__":
    main()
