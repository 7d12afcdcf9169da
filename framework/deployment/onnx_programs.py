"""Programs of torch.export as ONNX, and sessions of ONNX Runtime."""

import logging
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stderr, redirect_stdout
from functools import cache
from importlib.util import find_spec
from io import StringIO
from pathlib import Path
from typing import Any

import torch
from torch.fx import GraphModule

PACKAGES = ("onnx", "onnxscript", "onnxruntime")
"""Packages of the extra `export`."""


@cache
def can_run_onnx() -> bool:
    """Return whether all PACKAGES are installed."""
    return all(find_spec(name) is not None for name in PACKAGES)


@contextmanager
def quiet_export() -> Iterator[None]:
    """Drop the many messages of PyTorch's exporter inside the block, and compute no gradients."""
    printed = StringIO()
    previous = logging.root.manager.disable
    with warnings.catch_warnings(), redirect_stdout(printed), redirect_stderr(printed), torch.no_grad():
        warnings.simplefilter("ignore")
        logging.disable(logging.ERROR)
        try:
            yield
        finally:
            logging.disable(previous)


def write_onnx(
    program: torch.export.ExportedProgram, inputs: Sequence[str], outputs: Sequence[str], file: Any
) -> None:
    """Write a traced program as ONNX, with names of its inputs and outputs.

    The file holds no notes of PyTorch on the origin of each operation, which contain paths and lines of source code of
    the machine that exports.
    """
    # a density may draw an empty sample to learn its type; ONNX has no form for such draws
    _remove_unused(program.graph_module)
    written = torch.onnx.export(
        program, input_names=list(inputs), output_names=list(outputs), verbose=False, optimize=True
    )
    assert written is not None
    _remove_notes(written.model)
    written.save(file)


def _remove_notes(model: Any) -> None:
    """Remove the metadata of a model of onnxscript's intermediate representation, of its graphs and of their parts."""
    graphs = [model.graph, *model.functions.values()]
    nodes = [node for graph in graphs for node in graph.all_nodes()]
    values = [value for node in nodes for value in (*node.inputs, *node.outputs) if value is not None]
    interface = [value for graph in graphs for value in (*graph.inputs, *graph.outputs)]
    initializers = model.graph.initializers.values()
    for part in (model, *graphs, *nodes, *values, *interface, *initializers):
        part.metadata_props.clear()
        part.doc_string = None


def _remove_unused(traced: GraphModule) -> None:
    """Remove operations whose results are not used, also draws of random numbers."""
    for node in reversed(list(traced.graph.nodes)):
        if node.op in ("call_function", "get_attr") and not node.users and "assert" not in str(node.target):
            traced.graph.erase_node(node)
    traced.delete_all_unused_submodules()


class Session:
    """A session of ONNX Runtime that can be copied and pickled.

    Attributes:
        run: method `run` of ONNX Runtime's session.
    """

    def __init__(self, model: Path | bytes, threads: int = 1) -> None:
        """Open a session.

        Args:
            model: an ONNX file, or the content of such a file.
            threads: number of threads.
        """
        import onnxruntime

        self._arguments = model, threads
        options = onnxruntime.SessionOptions()
        options.log_severity_level = 3  # errors
        options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
        source = model if isinstance(model, bytes) else str(model)
        session = onnxruntime.InferenceSession(source, options, providers=["CPUExecutionProvider"])
        self.run: Callable[..., Any] = session.run

    def __reduce__(self) -> tuple[type["Session"], tuple[Path | bytes, int]]:
        return Session, self._arguments
