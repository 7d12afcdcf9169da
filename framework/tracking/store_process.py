"""Store in a separate process, so that the process that trains never imports MLflow.

Requests and answers are lines of JSON. The process ends when its input ends, that is, when the input is closed or the
requesting process has died.
"""

import json
import logging
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any, BinaryIO, final

from pydantic import TypeAdapter

from framework.errors import DataError
from framework.tracking.run_info import RunInfo
from framework.tracking.sender import Record, Store, reason

_log = logging.getLogger(__name__)
_COMMAND = (sys.executable, "-P", "-m", __name__)
_ENDING = 5.0  # seconds in which the process must end by itself


class StoreAway(Exception):
    """Error for a store that is locked, full or away, or for a store process that has ended."""


@final
class StoreProcess:
    """Function object (`sender.OpenStore`) that opens runs in MLflow in one process, started at the first call."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None

    def __call__(self, folder: Path, info: RunInfo) -> Store:
        if self._process is not None and self._process.poll() is not None:
            self.end()
        if self._process is None:
            # a session of its own, because Ctrl-C is meant for the training, which then tells this process to end
            self._process = subprocess.Popen(
                _COMMAND, stdin=subprocess.PIPE, stdout=subprocess.PIPE, start_new_session=True
            )
        return _DistantStore(self, folder, info)

    def ask(self, **question: Any) -> Mapping[str, Any]:
        """Send a request to the process and return its answer; its log messages are logged here.

        Raises:
            DataError: The store may not accept a file.
            StoreAway: The store failed, or the process has ended.
        """
        process = self._process
        assert process is not None and process.stdin is not None and process.stdout is not None
        line = b""
        with suppress(BrokenPipeError):
            process.stdin.write(json.dumps(question).encode() + b"\n")
            process.stdin.flush()
            line = process.stdout.readline()
        gone = {"error": "the sending process has ended", "refused": False}
        answer: dict[str, Any] = json.loads(line) if line else gone
        for level, text in answer.get("said", ()):
            _log.log(level, "%s", text)
        if "error" in answer:
            raise DataError(answer["error"]) if answer["refused"] else StoreAway(answer["error"])
        return answer

    def end(self, *, at_once: bool = False) -> None:
        """End the process; with `at_once`, even while it handles a request."""
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


@final
class _DistantStore(Store):
    def __init__(self, process: StoreProcess, folder: Path, info: RunInfo) -> None:
        self._process = process
        answer = process.ask(open=str(folder), info=asdict(info))
        # JSON turns tuples into lists
        owed = tuple((path, place) for path, place in answer["identity"]["owed"])
        self.identity, self.replay = {**answer["identity"], "owed": owed}, answer["replay"]

    def send(self, batch: Sequence[Record]) -> None:
        self.replay = self._process.ask(send=batch)["replay"]

    def send_file(self, path: str, place: str) -> None:
        self._process.ask(send_file=path, place=place)


class _Said(logging.Handler):
    """Log handler that keeps the messages for the next answer."""

    def __init__(self) -> None:
        logging.Handler.__init__(self, logging.WARNING)
        self.lines: list[tuple[int, str]] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append((record.levelno, record.getMessage()))


def serve(questions: BinaryIO, answers: BinaryIO) -> None:
    """Read requests and write answers until the requests end."""
    said = _Said()
    logging.getLogger().addHandler(said)
    store: Store | None = None
    for line in questions:
        question = json.loads(line)
        try:
            if "open" in question:
                # the import takes seconds, for which the requesting process waits
                from framework.tracking.mlflow_store import MlflowStore

                info = TypeAdapter(RunInfo).validate_python(question["info"])
                store = MlflowStore(Path(question["open"]), info)
            assert store is not None, "a run is opened first"
            if "send" in question:
                store.send(question["send"])
            elif "send_file" in question:
                store.send_file(question["send_file"], question["place"])
            answer: dict[str, Any] = {"identity": dict(store.identity), "replay": dict(store.replay)}
        except Exception as error:
            refused = isinstance(error, DataError)
            answer = {"error": str(error) if refused else reason(error), "refused": refused}
        answer["said"], said.lines = said.lines, []
        try:
            answers.write(json.dumps(answer).encode() + b"\n")
            answers.flush()
        except BrokenPipeError:  # the requesting process has died
            return


def main() -> None:
    """Answer requests from standard input; redirect what MLflow prints to standard error, away from the answers."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    serve(sys.stdin.buffer, answers)


if __name__ == "__main__":
    main()
