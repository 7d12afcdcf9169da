"""A small web service for an exported model, with FastAPI and ONNX Runtime.

    pip install fastapi uvicorn numpy onnxruntime
    python serve.py --port 8000

`POST /predict` reads {"inputs": [[...], ...], "interval": 0.9} as JSON, or the bytes of a .npy file
(`Content-Type: application/octet-stream`), and returns {"predictions": [{...}, ...]}. `GET /model` returns
density.json. The service listens on this machine only (127.0.0.1), unless `--host` names another address.
"""

import argparse
import io
import json
from typing import Any

import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Request, Response

from framework.deployment.exported_folder.predict import Model, load

MOST_BYTES = 64 * 2**20
"""Largest size of a request."""
MOST_ROWS = 10_000
"""Largest number of inputs in a request."""
DEEPEST = 8
"""Largest depth of nested brackets in JSON."""


def service(model: Model) -> FastAPI:
    """Return the web service of a model."""
    app = FastAPI(title="exported model", docs_url=None, redoc_url=None, openapi_url=None)

    @app.get("/ping")
    def ping() -> str:
        """Return a word, so that a load balancer knows that the service is up."""
        return "ok"

    @app.get("/model")
    def describe() -> dict[str, Any]:
        """Return the description of the model: inputs, target, family of the densities, calibration."""
        return model.description

    @app.post("/predict")
    async def predict(request: Request) -> Response:
        """Return a row of predictions for each input of a request."""
        content = await _read(request)
        try:
            rows = _rows(model, request, content)
        except (ValueError, TypeError, EOFError, OverflowError) as error:
            raise HTTPException(400, str(error)[:500]) from None
        return Response(json.dumps({"predictions": rows}), media_type="application/json")

    return app


def _rows(model: Model, request: Request, content: bytes) -> list[dict[str, Any]]:
    """Return the predictions for the body of a request."""
    if request.headers.get("content-type", "").startswith("application/octet-stream"):
        inputs, interval = (
            np.load(io.BytesIO(content), allow_pickle=False),
            request.query_params.get("interval"),
        )
    else:
        inputs, interval = _read_json(content)
    level = None if interval is None else float(interval)
    if level is not None and not 0 < level < 1:
        raise ValueError("interval must be between 0 and 1.")
    inputs = np.asarray(inputs)
    if inputs.ndim and len(inputs) > MOST_ROWS:
        raise ValueError(f"Got {len(inputs)} inputs, but at most {MOST_ROWS} are allowed in a request.")
    return list(model.table(inputs, level))


async def _read(request: Request) -> bytes:
    """Return the body of a request; refuse a body that is larger than MOST_BYTES while it arrives."""
    parts, size = [], 0
    async for part in request.stream():
        size += len(part)
        if size > MOST_BYTES:
            raise HTTPException(413, f"The request is larger than {MOST_BYTES} bytes.")
        parts.append(part)
    return b"".join(parts)


def _read_json(content: bytes) -> tuple[Any, Any]:
    """Return the inputs and the interval of a JSON request."""
    depth = deepest = 0
    for letter in content:
        depth += (letter in b"[{") - (letter in b"]}")
        deepest = max(deepest, depth)
        if deepest > DEEPEST:
            raise ValueError(f"The JSON has more than {DEEPEST} nested brackets.")
    asked = json.loads(content)
    if not isinstance(asked, dict) or "inputs" not in asked or set(asked) - {"inputs", "interval"}:
        raise ValueError('Expected {"inputs": [...], "interval": 0.9}; interval may be left out.')
    return asked["inputs"], asked.get("interval")


def main() -> None:
    """Start the service."""
    parser = argparse.ArgumentParser(description="Serve an exported model.")
    parser.add_argument(
        "--host", default="127.0.0.1", help="address to listen on; by default this machine only"
    )
    parser.add_argument("--port", type=int, default=8000)
    options = parser.parse_args()
    model = load()
    shape = [1 if isinstance(size, str) else size for size in model.description["input"]["shape"]]
    model(np.zeros(shape))  # the first request is as fast as the others
    uvicorn.run(service(model), host=options.host, port=options.port, log_level="warning")


if __name__ == "__main__":
    main()
