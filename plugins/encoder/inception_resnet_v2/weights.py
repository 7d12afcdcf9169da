"""Fills a network from a local file of weights trained elsewhere, or says what differs."""

import logging

from torch import nn

from framework.errors import CheckpointError
from framework.model import describe_mismatch
from framework.storage.weights import read_weights

_log = logging.getLogger(__name__)


def fill_from_file(network: nn.Module, file: str, ignored: tuple[str, ...]) -> None:
    """Copy the weights of `file` into `network`, name by name.

    Args:
        network: whose `state_dict` names the weights.
        file: what `read_weights` reads.
        ignored: beginnings of names the network has no use for, such as the classifier's; they may be absent.

    Raises:
        ConfigError: there is no such file.
        CheckpointError: it cannot be read, or its names or shapes are not the network's.
    """
    found = read_weights(file)
    kept = {name: tensor for name, tensor in found.items() if not name.startswith(ignored)}
    if len(kept) < len(found):
        names = ", ".join(sorted(found.keys() - kept.keys()))
        _log.info("%s: ignored %s, not used here.", file, names)
    wanted = network.state_dict()
    # Batch norm counts its batches since torch 0.4.1 only; older files lack the count, and nothing reads it.
    counters = {name: tensor for name, tensor in wanted.items() if name.endswith(".num_batches_tracked")}
    kept = counters | kept
    mismatch = describe_mismatch(wanted, kept)
    if mismatch:
        raise CheckpointError(
            f"{file} does not fit {type(network).__name__}: {mismatch} Give a file with its names and shapes."
        )
    network.load_state_dict(kept)
