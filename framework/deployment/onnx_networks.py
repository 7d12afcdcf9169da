"""Networks of a frozen model computed by ONNX Runtime."""

import math
from collections.abc import Sequence
from io import BytesIO

import numpy as np
import torch
from torch import Tensor, nn

from framework.density_head import Fitted
from framework.deployment.onnx_programs import Session, can_run_onnx, quiet_export, write_onnx
from framework.model import Model, Predictor, RawNetwork
from framework.uncertainty import Uncertainty

PROBES = (1, 3)
"""Batch sizes for which a network of ONNX Runtime is compared with the original network."""
AGREEMENT = 1e-5
"""Largest accepted difference between the raw parameters of ONNX Runtime and of torch.

It is a share of the largest parameter, or of 1 if this parameter is smaller.
"""


class OnnxNetwork(nn.Module):
    """A network computed by ONNX Runtime for inputs of one shape and type on the CPU, and by torch for others.

    Args:
        network: the network, which returns raw parameters, (batch, *raw).
        probe: inputs with which the network is traced, at least two samples.

    Raises:
        ArithmeticError: the results of ONNX Runtime differ from those of torch.
    """

    def __init__(self, network: nn.Module, probe: Tensor) -> None:
        super().__init__()
        self.network = network
        self.shape, self.dtype = probe.shape[1:], probe.dtype
        batch = {0: torch.export.Dim("batch", min=1)}
        with quiet_export(), torch.no_grad():
            program = torch.export.export(network, (probe,), dynamic_shapes=(batch,), strict=False)
            stream = BytesIO()
            write_onnx(program, ["input"], ["raw"], stream)
            self.session = Session(stream.getvalue(), torch.get_num_threads())
            for count in PROBES:
                actual, expected = self(probe[:count]), network(probe[:count])
                away = (actual - expected).abs().max() / expected.abs().max().clamp(min=1)
                if not away <= AGREEMENT:
                    raise ArithmeticError

    def forward(self, inputs: Tensor, used: int | None = None) -> Tensor:
        """Return the raw parameters; `used` limits the result to the first members of an ensemble.

        Args:
            inputs: inputs of the network.
            used: number of members whose raw parameters are returned, if the network is a `RawNetwork`, which computes
                all members of an ensemble; None for all members, and for any other network.
        """
        same = inputs.shape[1:] == self.shape and inputs.dtype == self.dtype and len(inputs)
        # ONNX Runtime may drop NaN in a maximum
        if not same or not math.isfinite(inputs.sum()):
            return self.network(inputs) if used is None else self.network(inputs, used)
        array = np.ascontiguousarray(inputs.detach().numpy())
        raw = torch.from_numpy(self.session.run(None, {"input": array})[0])
        return raw if used is None else raw[:, :used]


def use_onnx(predictor: Predictor, shape: Sequence[int], dtype: torch.dtype) -> int:
    """Replace the networks of a predictor, in place, by networks that ONNX Runtime computes where this is possible.

    A network is not replaced in any of these cases:
    - The packages of ONNX are not installed.
    - Its inputs are point clouds, because the encoders check the values of clouds.
    - A layer, such as dropout, is random in evaluation.
    - An uncertainty wrapper varies its weights.
    - ONNX cannot express one of its layers, or ONNX Runtime returns other results than torch (`AGREEMENT`).

    Args:
        predictor: predictor in evaluation mode, on the CPU.
        shape: shape of one input.
        dtype: type of the inputs.

    Returns:
        Number of replaced networks.
    """
    if not can_run_onnx() or len(shape) == 2 or not shape:
        return 0
    probe = _probe(max(PROBES), shape, dtype)
    if _trains(predictor, probe):
        return 0
    count = 0
    torch_only = {
        part
        for wrapper in predictor.modules()
        if isinstance(wrapper, Uncertainty) and wrapper.varies_weights
        for part in wrapper.modules()
    }
    for module in (module for module in list(predictor.modules()) if module not in torch_only):
        trained = next(module.parameters(), None) is not None
        if isinstance(module, Model) and not isinstance(module.head, Fitted) and trained:
            network = _converted(nn.Sequential(module.encoders, module.projection), probe)
            if network is not None:
                module.encoders, module.projection = nn.Sequential(network), nn.Identity()
                count += 1
        for name, child in list(module.named_children()):
            if isinstance(child, RawNetwork) and (network := _converted(child, probe)) is not None:
                setattr(module, name, network)
                count += 1
    return count


def _converted(network: nn.Module, probe: Tensor) -> OnnxNetwork | None:
    try:
        return OnnxNetwork(network, probe)
    except Exception:  # the exporter raises many kinds of errors, depending on the layers
        return None


def _probe(count: int, shape: Sequence[int], dtype: torch.dtype) -> Tensor:
    """Return random inputs, (count, *shape)."""
    generator = torch.Generator().manual_seed(0)
    if dtype == torch.uint8:
        return torch.randint(0, 256, (count, *shape), generator=generator, dtype=dtype)
    return torch.randn(count, *shape, generator=generator, dtype=torch.float64).to(dtype)


@torch.no_grad()
def _trains(predictor: Predictor, probe: Tensor) -> bool:
    """Return whether a layer is in training mode while the predictor evaluates, as dropout layers may be.

    The result is also true if the predictor cannot read `probe`.
    """
    trains: list[bool] = []
    hooks = [
        module.register_forward_pre_hook(lambda module, _: trains.append(module.training))
        for module in predictor.modules()
    ]
    try:
        with torch.random.fork_rng([]):
            predictor(probe)
    except Exception:  # random numbers are not inputs of this model
        return True
    finally:
        for hook in hooks:
            hook.remove()
    return any(trains)
