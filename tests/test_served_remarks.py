"""Responses of a server, which contain the remarks of calibrated wrappers, and texts of densities over classes."""

import asyncio
import pickle
from collections.abc import MutableMapping
from typing import Any

import pytest
import torch
from torch.distributions import Categorical, kl_divergence

from framework.configuration.schema import build, resolve
from framework.deployment.request_bounds import INVOCATIONS, REMARK, TICKET, BoundedApp
from framework.distributions.description import LONGEST
from framework.distributions.protocol import pick
from framework.target import Target
from plugins.uncertainty.conformal.prediction_set import PredictionSet


@pytest.mark.parametrize("remarks", [(), ("conformal: set by 14 rows",), ("one", "κ = 3\nSet-Cookie: x")])
def test_an_answer_carries_the_remarks_of_its_model(remarks: tuple[str, ...]) -> None:
    async def model(scope: Any, receive: Any, send: Any) -> None:
        ticket = TICKET.get()
        assert ticket is not None
        ticket.remarks = remarks
        await send({"type": "http.response.start", "status": 200, "headers": []})
        await send({"type": "http.response.body", "body": b"{}"})

    sent: list[MutableMapping[str, Any]] = []

    async def receive() -> MutableMapping[str, Any]:
        return {"type": "http.request", "body": b'{"inputs": [[1.0]]}', "more_body": False}

    async def send(message: MutableMapping[str, Any]) -> None:
        sent.append(message)

    headers = [(b"content-type", b"application/json")]
    scope = {"type": "http", "path": INVOCATIONS, "method": "POST", "headers": headers}
    asyncio.run(BoundedApp(model, 10)(scope, receive, send))
    assert sent[0]["status"] == 200
    found = [value for name, value in sent[0]["headers"] if name == REMARK]
    assert len(found) == len(remarks)
    assert not any(byte < 32 or byte > 126 for value in found for byte in value), (
        "a header is one line of ASCII"
    )


def densities() -> dict[str, Any]:
    target = Target("class", ("cat", "dog"))
    head = build("density_head", resolve("density_head", "categorical"), target=target)
    bernoulli = build("density_head", resolve("density_head", "bernoulli"), target=target)
    plain = head(torch.tensor([[0.0, 1.0]]))
    return {
        "categorical": plain,
        "bernoulli": bernoulli(torch.tensor([[1.0]])),
        "picked": pick(head(torch.tensor([[[0.0, 1.0], [3.0, 1.0]]])), torch.tensor([0])),
        "set": PredictionSet(plain, torch.tensor(0.7), "density", 0.9),
    }


@pytest.mark.parametrize("kind", ["categorical", "bernoulli", "picked", "set"])
def test_a_density_of_classes_prints_names_and_values(kind: str) -> None:
    density = densities()[kind]
    density.names = ("cat", "dog")
    for one in (density, pickle.loads(pickle.dumps(density))):
        line = repr(one)
        assert "batch=(1,)" in line and "names=cat, dog" in line and "\n" not in line and len(line) <= LONGEST
        assert "[-1.313, -0.3133]" in line, line
        if kind == "set":
            assert "stated_probability=0.9" in line and "threshold=[0.7]" in line


def test_it_is_a_categorical_of_torch_for_everything_else() -> None:
    density = densities()["categorical"]
    twin = Categorical(logits=density.logits)
    assert isinstance(density, Categorical)
    assert float(kl_divergence(density, twin)) == pytest.approx(0.0, abs=1e-7)
    assert repr(density.expand((3,))).startswith("CategoricalDensity(batch=(3,)")
