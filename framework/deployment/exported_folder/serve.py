"""A small web service for an exported model, with FastAPI and ONNX Runtime.

    pip install fastapi uvicorn numpy onnxruntime
    python serve.py --port 8000

`POST /predict` reads {"inputs": [[...], ...], "interval": 0.9} as JSON, or the bytes of a .npy file
(`Content-Type: application/octet-stream`), and returns {"predictions": [{...}, ...]}. For a table, "far" lists
the rows (from 0) with a number far outside the training rows; their predictions are not reliable. `GET /model` returns
density.json. The service listens on this machine only (127.0.0.1), unless `--host` names another address.
"""

import argparse
import json
import math
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response
from fastapi.concurrency import run_in_threadpool
from numpy.lib import format as npy

from framework.deployment.exported_folder.predict import Model, load

MOST_BYTES = 64 * 2**20
"""Largest size of a request, bytes."""
MOST_ROWS = 10_000
"""Largest number of inputs in a request."""
LARGE = 2**15
"""Size of a request, bytes, above which it is answered in a thread, so that small requests need not wait for it."""


def service(model: Model) -> FastAPI:
    """Return the web service of a model."""
    app = FastAPI(title="exported model", docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/ping")
    async def ping() -> str:
        """Return a word, so that a load balancer knows that the service is up."""
        return "ok"

    @app.get("/model")
    async def describe() -> dict[str, Any]:
        """Return the description of the model: inputs, target, family of the densities, calibration."""
        return model.description

    async def predict(request: Request) -> Response:
        """Return a row of predictions for each input of a request."""
        content = await _read(request)
        binary = request.headers.get("content-type", "").startswith("application/octet-stream")
        interval = request.query_params.get("interval") if binary else None
        try:
            if len(content) > LARGE:
                answer = await run_in_threadpool(_answer, model, content, binary, interval)
            else:
                answer = _answer(model, content, binary, interval)
        except (ValueError, TypeError, OverflowError) as error:
            raise HTTPException(400, str(error)[:500]) from None
        except RecursionError:
            raise HTTPException(400, "The JSON is nested too deeply.") from None
        return Response(answer, media_type="application/json")

    # a route without FastAPI's validation, which a body of numbers does not need
    app.add_route("/predict", predict, methods=["POST"])
    return app


def _answer(model: Model, content: bytes, binary: bool, interval: Any) -> bytes:
    """Return the predictions for the body of a request as JSON.

    Args:
        model: the model.
        content: the body.
        binary: whether the body is a .npy file.
        interval: probability of the interval, for a .npy file; JSON holds it itself.
    """
    if binary:
        inputs = read_npy(content)
    else:
        inputs, interval = _read_json(content)
    level = None if interval is None else float(interval)
    if level is not None and not 0 < level < 1:
        raise ValueError("interval must be between 0 and 1.")
    count = len(inputs) if isinstance(inputs, list) or inputs.ndim else 0
    if count > MOST_ROWS:
        raise ValueError(f"Got {count} inputs, but at most {MOST_ROWS} are allowed in a request.")
    if model.ranges is not None:
        inputs = np.asarray(inputs)
    rows = [{name: _finite(cell) for name, cell in row.items()} for row in model.table(inputs, level)]
    answer: dict[str, Any] = {"predictions": rows}
    if model.ranges is not None:
        answer["far"] = np.flatnonzero(model.far(inputs).any(1)).tolist()
    return json.dumps(answer).encode()


def _finite(cell: Any) -> Any:
    """Return a cell, but None for a number that JSON lacks: an infinite end of a set, or NaN for an empty set."""
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell


async def _read(request: Request) -> bytes:
    """Return the body of a request; refuse a body that is larger than MOST_BYTES while it arrives."""
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > MOST_BYTES:
            raise HTTPException(413, f"The request is larger than {MOST_BYTES} bytes.")
        parts.append(part)
    return b"".join(parts)


def read_npy(content: bytes) -> Any:
    """Return the array of a .npy file without a copy; no memory is allocated for a size that the file only states.

    Raises:
        ValueError: the content is no .npy file of numbers, or is cut off.
    """
    stream = BytesIO(content)
    try:
        read = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}[npy.read_magic(stream)]
        shape, fortran, dtype = read(stream)
    except Exception:  # the parser raises errors of many kinds
        raise ValueError("The body is no .npy file.") from None
    if dtype.kind not in "buif" or (fortran and len(shape) > 1):
        raise ValueError(f"The .npy file holds {dtype} in an unsupported order; expected numbers in C order.")
    if any(size < 0 for size in shape) or math.prod(shape) * dtype.itemsize != len(content) - stream.tell():
        raise ValueError("The .npy file has another length than its shape says.")
    return np.frombuffer(content, dtype, offset=stream.tell()).reshape(shape)


def _read_json(content: bytes) -> tuple[Any, Any]:
    """Return the inputs and the interval of a JSON request."""
    try:
        request = json.loads(content)
    except UnicodeDecodeError:
        raise ValueError("The body is not JSON in UTF-8.") from None
    except json.JSONDecodeError as error:
        raise ValueError(
            f'The body is not JSON: {error}. Send {{"inputs": [...]}}, or a .npy file as application/octet-stream.'
        ) from None
    if not isinstance(request, dict) or "inputs" not in request or set(request) - {"inputs", "interval"}:
        raise ValueError('Expected {"inputs": [...], "interval": 0.9}; interval may be left out.')
    if not isinstance(request["inputs"], list):
        raise ValueError("inputs must be a list.")
    return request["inputs"], request.get("interval")


def application() -> FastAPI:
    """Return the service of the model in this file's folder, after a first prediction, so that no request waits."""
    model = load(Path(__file__).parent)
    shape = [1 if isinstance(size, str) else size for size in model.description["input"]["shape"]]
    list(model.table(np.zeros(shape)))
    return service(model)


def main() -> None:
    """Start the service."""
    parser = argparse.ArgumentParser(description="Serve an exported model.")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; by default this machine only"
    )
    parser.add_argument("--port", type=int, default=8000)
    parser.add_argument("--workers", type=int, default=1, help="number of processes")
    options = parser.parse_args()
    uvicorn.run(
        "serve:application", factory=True, host=options.host, port=options.port, workers=options.workers,
        log_level="warning", access_log=False,
    )  # fmt: skip


if __name__ == "__main__":
    main()
