"""Limits on the requests that `mlflow models serve` answers; they apply before MLflow parses a body.

MLflow's server reads bodies of any size, parses JSON of any depth, and answers errors with stack traces. It has no
setting that changes this, and calls the model only after it has parsed the request.
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
    Refusal,
    content_type,
    expected_body,
    require_bounded,
    too_large_message,
)
from framework.errors import DataError, escape_unprintable, shorten

INVOCATIONS = "/invocations"
MOST_DISCARDED = 2**28
"""Largest number of bytes of a refused body that are received and discarded."""

Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[MutableMapping[str, Any], Receive, Send], Awaitable[None]]

_log = logging.getLogger(__name__)


@dataclass
class Ticket:
    """Data that server and model exchange about one request.

    Attributes:
        seconds: time limit of the request.
        deadline: end of the time limit, as a value of `time.monotonic`.
        sentence: message that says why the model refused the request; "" if it did not.
        remarks: remarks in the model's description, which are sent to the client with the table of predictions.
    """

    seconds: float
    deadline: float
    sentence: str = ""
    remarks: Sequence[str] = ()

    def require_time(self) -> None:
        """Raise an error if the deadline has passed.

        Raises:
            DataError: the deadline has passed.
        """
        if time.monotonic() > self.deadline:
            self.sentence = too_long_message(self.seconds)
            raise DataError(self.sentence)


REMARK = b"x-model-remark"
"""Name of the response header for a remark in the model's description (`Description.remarks`)."""


@dataclass
class ReceivedBody:
    """State of a body that is being received: the number of bytes so far, and whether the body is complete."""

    size: int = 0
    complete: bool = False


TICKET: ContextVar[Ticket | None] = ContextVar("ticket", default=None)
"""Data of the request that is being answered (`Ticket`); None if there is none, as outside of a server."""


def too_long_message(seconds: float) -> str:
    """Return the message about a request that exceeds the time limit."""
    return (
        f"The request was not answered within the time limit of {seconds:g} s. Send fewer rows, or smaller files; or "
        "start the server with a longer limit: mlflow models serve --timeout."
    )


@final
class BoundedApp:
    """ASGI application that passes requests to MLflow's application within limits of size and time.

    Args:
        app: MLflow's application.
        seconds: time limit of a request, from its first byte to the response.
        samples: JSON bodies of sample requests, which are answered before the server accepts connections, so that no
            client waits for imports and compilation.
    """

    def __init__(self, app: App, seconds: float, samples: Iterable[bytes] = ()) -> None:
        self.app, self.seconds, self.samples = app, seconds, samples
        self.stored_bytes = 0  # size of all bodies that are in memory now

    async def __call__(self, scope: MutableMapping[str, Any], receive: Receive, send: Send) -> None:
        """Answer a request for predictions within the limits; pass any other request on to `app` unchanged."""
        if scope["type"] == "lifespan":
            await self._warm_up()
        if scope["type"] != "http" or scope["path"] != INVOCATIONS or scope["method"] != "POST":
            await self.app(scope, receive, send)
            return
        received = ReceivedBody()
        try:
            await self._respond(scope, receive, send, received)
        except Refusal as refusal:
            await _refuse(None if received.complete else receive, send, refusal)
        finally:
            self.stored_bytes -= received.size

    async def _respond(
        self, scope: MutableMapping[str, Any], receive: Receive, send: Send, received: ReceivedBody
    ) -> None:
        """Answer a request to the model.

        Raises:
            Refusal: the request exceeds a limit, or the model refuses it.
        """
        ticket = Ticket(self.seconds, time.monotonic() + self.seconds)
        headers = dict(scope["headers"])
        kind, body = content_type(headers), None
        try:
            async with asyncio.timeout(self.seconds):
                body = await self._body(headers, receive, received)
                if body is None:
                    return
                await asyncio.to_thread(require_bounded, body, kind)
                status, content, media = await self._call_app(scope, receive, body, kind, ticket)
        except TimeoutError:
            raise Refusal(408 if body is None else 413, too_long_message(self.seconds)) from None
        if status >= 400:
            raise Refusal(_client_status(status), ticket.sentence or _parse_message(content, kind))
        await _send(send, status, content, media, remarks=ticket.remarks)

    async def _body(
        self, headers: Mapping[bytes, bytes], receive: Receive, received: ReceivedBody
    ) -> bytes | None:
        """Receive the body of a request and return it; None if the client has disconnected."""
        length = headers.get(b"content-length", b"")
        if length.isdigit() and int(length[:20]) > MOST_BODY:
            raise Refusal(413, too_large_message(f"{int(length[:20])} bytes"))
        parts: list[bytes] = []
        while True:
            message = await receive()
            if message["type"] == "http.disconnect":
                return None
            part = message.get("body", b"")
            parts.append(part)
            received.size += len(part)
            self.stored_bytes += len(part)
            if received.size > MOST_BODY:
                raise Refusal(413, too_large_message(f"more than {MOST_BODY} bytes"))
            if self.stored_bytes > AT_ONCE and self.stored_bytes > received.size:
                raise Refusal(
                    503, "The server is busy with other large requests. Send this request again later."
                )
            if not message.get("more_body", False):
                received.complete = True
                return b"".join(parts)

    async def _call_app(
        self, scope: MutableMapping[str, Any], receive: Receive, body: bytes, kind: str, ticket: Ticket
    ) -> tuple[int, bytes, bytes]:
        """Return status, content and media type of MLflow's response."""
        # The content type is rewritten in the form that MLflow accepts (lower case, no quoted charset).
        headers = [pair for pair in scope["headers"] if pair[0] not in (b"content-type", b"content-length")]
        headers += [(b"content-type", kind.encode()), (b"content-length", str(len(body)).encode())]
        waiting = [{"type": "http.request", "body": body, "more_body": False}]
        status, media, content = 500, b"application/json", []

        async def read() -> Message:
            return waiting.pop() if waiting else await receive()

        async def store(message: Message) -> None:
            nonlocal status, media
            if message["type"] == "http.response.start":
                status = message["status"]
                media = dict(message.get("headers", ())).get(b"content-type", media)
            else:
                content.append(message.get("body", b""))

        token = TICKET.set(ticket)
        try:
            await self.app({**scope, "headers": headers}, read, store)
        except TimeoutError:
            raise
        except Exception:  # Starlette has answered with status 500, and raises the error for the log
            _log.exception("MLflow could not answer a request.")
        finally:
            TICKET.reset(token)
        return status, b"".join(content), media

    async def _warm_up(self) -> None:
        """Answer the sample requests and discard the responses."""
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
                return await asyncio.Future()  # the client stays connected

            await self({**scope, "headers": headers}, read, drop)


def bound_server(samples: Iterable[bytes]) -> None:
    """Limit the requests of the MLflow server that is starting in this process, if there is one.

    `mlflow models serve` runs uvicorn with `mlflow.pyfunc.scoring_server.app`. That module loads the model and then
    creates its application, an instance of FastAPI. Only between these two steps can the model change the application,
    so it replaces the class FastAPI. The class is restored when the application has been created.
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
            super().__init__(docs_url=None, redoc_url=None)  # these pages load scripts from other servers
            self.bounded = BoundedApp(super().__call__, seconds, samples)

        async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
            await self.bounded(scope, receive, send)

    fastapi.FastAPI = BoundedFastAPI


def _client_status(status: int) -> int:
    """Return the HTTP status for the client if MLflow has answered with `status`.

    A body that MLflow cannot process is an error of the client (4xx), although MLflow may answer with 5xx. The status
    504, by which MLflow reports its time limit, becomes 413.
    """
    return {504: 413}.get(status, status if status < 500 else 400)


def _parse_message(content: bytes, kind: str) -> str:
    """Return a message about a request that MLflow cannot parse, with MLflow's message but no stack trace."""
    try:
        reason = str(json.loads(content)["message"])
    except (ValueError, KeyError, TypeError):
        reason = ""
    reason = shorten(re.split(r"\bError: ", reason)[-1], 300)
    return f"The request cannot be read{f' ({reason})' if reason else ''}. Send {expected_body(kind)}."


async def _refuse(receive: Receive | None, send: Send, refusal: Refusal) -> None:
    """Send the refusal to the client, and receive and discard the rest of the body.

    The rest is received because many clients read a response only after they have sent the whole body. `receive` is
    None if the body is complete.
    """
    name = "TEMPORARILY_UNAVAILABLE" if refusal.status == 503 else "INVALID_PARAMETER_VALUE"
    content = json.dumps({"error_code": name, "message": str(refusal)}).encode()
    await _send(send, refusal.status, content, b"application/json", close=receive is not None)
    if receive is None:  # the body is complete
        return
    left, end = MOST_DISCARDED, time.monotonic() + 10
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
    """Send a response.

    Each remark is sent as a header, because a table of predictions has no field for remarks.

    Args:
        send: function that sends ASGI messages to the client.
        status: HTTP status.
        content: body of the response.
        media: media type of the body.
        remarks: remarks on the predictions.
        close: if True, announce that the connection closes, and leave the response open; the caller ends it later.
    """
    headers = [(b"content-type", media), (b"content-length", str(len(content)).encode())]
    headers += [
        (REMARK, escape_unprintable(remark, allowed="").encode("ascii", "backslashreplace"))
        for remark in remarks
    ]
    headers += [(b"connection", b"close")] * close
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": content, "more_body": close})
