"""Bounds on the requests that `mlflow models serve` answers: they hold before MLflow parses a body.

This is code of our own because MLflow's server reads bodies of any size, parses JSON of any depth, and answers errors
with stack traces; it has no setting for any of these, and calls the model only after it has parsed the request.
"""

import asyncio
import contextlib
import json
import logging
import re
import sys
import time
from collections.abc import Awaitable, Callable, Iterable, Mapping, MutableMapping, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, final

from framework.deployment.request_bodies import (
    AT_ONCE,
    MOST_BODY,
    Refused,
    content_type,
    require_bounded,
    too_large,
    wanted_of,
)
from framework.errors import DataError, printable, shown

INVOCATIONS = "/invocations"
MOST_PASSED_OVER = 2**28
"""Bytes that are received of a refused body, and not kept."""

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

_log = logging.getLogger(__name__)


@dataclass
class Ticket:
    """What the server and the model say to each other about one request.

    Attributes:
        seconds: what the request may take.
        deadline: when it ends, by `time.monotonic`.
        sentence: why the model refused the request.
        remarks: what an answer says beside its table.
    """

    seconds: float
    deadline: float
    sentence: str = ""
    remarks: Sequence[str] = ()

    def require_time(self) -> None:
        """Refuse to go on after the deadline.

        Raises:
            DataError: the request has taken too long.
        """
        if time.monotonic() > self.deadline:
            self.sentence = too_long(self.seconds)
            raise DataError(self.sentence)


REMARK = b"x-model-remark"
"""Header of an answer with what a wrapper of the model found when it was calibrated."""


@dataclass
class Received:
    """What has come of a body: bytes, and whether that is all."""

    size: int = 0
    complete: bool = False


TICKET: ContextVar[Ticket | None] = ContextVar("ticket", default=None)
"""The request that is being answered; None in a process that is no server."""


def too_long(seconds: float) -> str:
    """Return the sentence for a request that takes longer than it may."""
    return (
        f"The request was not answered within {seconds:g} s, which is the most. Send fewer rows, or smaller files; "
        "who starts the server sets the time: mlflow models serve --timeout."
    )


@final
class Bounded:
    """An ASGI application that answers requests within bounds by another one, MLflow's.

    Args:
        app: MLflow's application.
        seconds: what a request may take, from its first byte to its answer.
        samples: bodies of JSON, answered once before the server listens, so that no client waits for imports and
            compilation.
    """

    def __init__(self, app: App, seconds: float, samples: Iterable[bytes] = ()) -> None:
        self.app, self.seconds, self.samples = app, seconds, samples
        self.held = 0  # bytes of bodies

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer a request, or hand on what is none for the model."""
        if scope["type"] == "lifespan":
            await self._warm_up()
        if scope["type"] != "http" or scope["path"] != INVOCATIONS or scope["method"] != "POST":
            await self.app(scope, receive, send)
            return
        received = Received()
        try:
            await self._answer(scope, receive, send, received)
        except Refused as refusal:
            await _refuse(None if received.complete else receive, send, refusal)
        finally:
            self.held -= received.size

    async def _answer(
        self, scope: MutableMapping[str, Any], receive: Receive, send: Send, received: Received
    ) -> None:
        ticket = Ticket(self.seconds, time.monotonic() + self.seconds)
        headers = dict(scope["headers"])
        kind, body = content_type(headers), None
        try:
            async with asyncio.timeout(self.seconds):
                body = await self._body(headers, receive, received)
                if body is None:
                    return
                await asyncio.to_thread(require_bounded, body, kind)
                status, content, media = await self._called(scope, receive, body, kind, ticket)
        except TimeoutError:
            raise Refused(408 if body is None else 413, too_long(self.seconds)) from None
        if status >= 400:
            raise Refused(_status(status), ticket.sentence or _sentence(content, kind))
        await _send(send, status, content, media, remarks=ticket.remarks)

    async def _body(
        self, headers: Mapping[bytes, bytes], receive: Receive, received: Received
    ) -> bytes | None:
        """Return the body; None where the client has gone away."""
        said = headers.get(b"content-length", b"")
        if said.isdigit() and int(said[:20]) > MOST_BODY:
            raise Refused(413, too_large(f"{int(said[:20])} bytes"))
        parts: list[bytes] = []
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return None
            part = message.get("body", b"")
            parts.append(part)
            received.size += len(part)
            self.held += len(part)
            if received.size > MOST_BODY:
                raise Refused(413, too_large(f"more than {MOST_BODY} bytes"))
            if self.held > AT_ONCE and self.held > received.size:
                raise Refused(503, "The server is busy with other large requests. Send this one again later.")
            if not message.get("more_body", False):
                received.complete = True
                return b"".join(parts)

    async def _called(
        self, scope: MutableMapping[str, Any], receive: Receive, body: bytes, kind: str, ticket: Ticket
    ) -> tuple[int, bytes, bytes]:
        """Return status, content and media type of MLflow's answer."""
        # what MLflow does not know of the content type (an upper-case name, a charset in quotes) is left out
        kept = [pair for pair in scope["headers"] if pair[0] not in (b"content-type", b"content-length")]
        kept += [(b"content-type", kind.encode()), (b"content-length", str(len(body)).encode())]
        waiting = [{"type": "http.request", "body": body, "more_body": False}]
        status, media, content = 500, b"application/json", []

        async def read() -> Message:
            return waiting.pop() if waiting else await receive()

        async def keep(message: Message) -> None:
            nonlocal status, media
            if message["type"] == "http.response.start":
                status = message["status"]
                media = dict(message.get("headers", ())).get(b"content-type", media)
            else:
                content.append(message.get("body", b""))

        token = TICKET.set(ticket)
        try:
            await self.app({**scope, "headers": kept}, read, keep)
        except TimeoutError:
            raise
        except Exception:  # Starlette answers 500, and raises for the log
            _log.exception("MLflow could not answer a request.")
        finally:
            TICKET.reset(token)
        return status, b"".join(content), media

    async def _warm_up(self) -> None:
        """Answer the made-up requests; what comes of them is of no interest."""
        headers = [(b"host", b"localhost"), (b"content-type", b"application/json")]
        scope = {"type": "http", "asgi": {"version": "3.0"}, "http_version": "1.1", "method": "POST"}
        scope |= {
            "scheme": "http",
            "path": INVOCATIONS,
            "raw_path": INVOCATIONS.encode(),
            "query_string": b"",
        }
        scope |= {"root_path": "", "client": ("127.0.0.1", 0), "server": ("127.0.0.1", 0)}

        async def drop(message: Message) -> None:
            pass

        for sample in self.samples:
            waiting: list[Message] = [{"type": "http.request", "body": sample, "more_body": False}]

            async def read(waiting: list[Message] = waiting) -> Message:
                if waiting:
                    return waiting.pop()
                return await asyncio.Future()  # the client stays

            await self({**scope, "headers": headers}, read, drop)


def bound_server(samples: Iterable[bytes]) -> None:
    """Bound the server of MLflow in this process, if it is one that is being started; otherwise do nothing.

    `mlflow models serve` runs uvicorn with `mlflow.pyfunc.scoring_server.app`. That module loads the model and then
    makes its application, a FastAPI: this is the only place where the application can be reached from the model. The
    class is put back when the application is made.
    """
    module = sys.modules.get("mlflow.pyfunc.scoring_server.app")
    if module is None or hasattr(module, "app"):
        return
    import fastapi
    from mlflow.environment_variables import MLFLOW_SCORING_SERVER_REQUEST_TIMEOUT

    seconds = float(MLFLOW_SCORING_SERVER_REQUEST_TIMEOUT.get())
    original = fastapi.FastAPI

    class BoundedFastAPI(original):
        def __init__(self) -> None:
            fastapi.FastAPI = original
            super().__init__(docs_url=None, redoc_url=None)  # pages that load scripts of other servers
            self.bounded = Bounded(super().__call__, seconds, samples)

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            await self.bounded(scope, receive, send)

    fastapi.FastAPI = BoundedFastAPI


def _status(status: int) -> int:
    """What a body leads MLflow to is the client's to mend, whatever MLflow says; 504 is its limit of time."""
    return {504: 413}.get(status, status if status < 500 else 400)


def _sentence(content: bytes, kind: str) -> str:
    """Return what MLflow says of a request that it cannot parse, without its stack trace."""
    try:
        said = str(json.loads(content)["message"])
    except (ValueError, KeyError, TypeError):
        said = ""
    said = shown(re.split(r"\bError: ", said)[-1], 300)
    return f"The request cannot be read{f' ({said})' if said else ''}; wanted {wanted_of(kind)}."


async def _refuse(receive: Receive | None, send: Send, refusal: Refused) -> None:
    """Send the sentence, and pass over the rest of the body: many clients read nothing before they have sent all."""
    name = "TEMPORARILY_UNAVAILABLE" if refusal.status == 503 else "INVALID_PARAMETER_VALUE"
    content = json.dumps({"error_code": name, "message": str(refusal)}).encode()
    await _send(send, refusal.status, content, b"application/json", close=receive is not None)
    if receive is None:  # all has come
        return
    left, end = MOST_PASSED_OVER, time.monotonic() + 10
    with contextlib.suppress(TimeoutError):
        while left > 0 and time.monotonic() < end:
            message = await asyncio.wait_for(receive(), 1)
            left -= len(message.get("body", b""))
            if message["type"] == "http.disconnect" or not message.get("more_body", False):
                break
    await send({"type": "http.response.body", "body": b""})


async def _send(
    send: Send,
    status: int,
    content: bytes,
    media: bytes,
    *,
    remarks: Iterable[str] = (),
    close: bool = False,
) -> None:
    """Send an answer; where the connection is to `close`, its end is left to the caller.

    Each of `remarks` is a header of its own: a table of predictions has no place for them.
    """
    headers = [(b"content-type", media), (b"content-length", str(len(content)).encode())]
    headers += [
        (REMARK, printable(remark, kept="").encode("ascii", "backslashreplace")) for remark in remarks
    ]
    headers += [(b"connection", b"close")] * close
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content, "more_body": close})
