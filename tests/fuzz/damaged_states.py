"""Checkpoints of every plugin that stores arrays, with one of the arrays damaged."""

import contextlib
import io
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch._utils import _rebuild_tensor_v2

from framework.configuration import loading
from framework.configuration.assembly import build_predictor
from framework.configuration.paths import paths_of
from framework.configuration.registry import installed
from framework.configuration.schema import build, resolve
from framework.density_head import DensityHead
from framework.errors import DataError, NonFiniteParameters, UserError
from framework.model import Predictor
from framework.storage import checkpoints
from framework.storage.checkpoints import TRAILER
from framework.storage.weights import fill_from_file
from framework.target import Target
from framework.testing.contract import contract
from framework.testing.head_subject import HeadSubject, fit_if_needed, values
from framework.testing.rows import EncoderRow, HeadRow, WrapperRow
from framework.training.checkpoint import WholeCheckpoints
from tests.fuzz.damage import Reader, Silent, spoilt
from tests.fuzz.damaged_files import saved, signed, written

LARGEST = 200_000
"""Largest size of the checkpoints that are damaged, bytes, since each is read thousands of times."""
SEED = 17
CLASSES = Target("class", ("a", "b"))
HEADS = {"class": "categorical", "real": "gaussian", "angle": "von_mises"}
SMALL = {"name": "mlp", "widths": [4], "dropout": 0.1}
HEAVY = {"inception_resnet_v2", "resnet"}
"""Plugins with networks of 40 MB and more, whose weights are read by the same code as those of other networks."""
OURS: set[str] = set()
"""Paths in the configs of the rows."""
TOLD = "fuzz"
"""Key of a checkpoint that holds the kind of damage and the predictions of the undamaged model."""


# ---- models of every row ------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Subject:
    """A model of one row of a plugin's contract.

    Attributes:
        parts: the resolved config.
        target: what it predicts.
        inputs: four samples, (4, *input_shape).
        columns: of the inputs.
    """

    parts: dict[str, Any]
    target: Target
    inputs: Tensor
    columns: tuple[str, ...] = ()

    def checkpoint(self) -> bytes:
        """Return the checkpoint of the fitted and calibrated model in the form that a run writes."""
        predictor = build_predictor(
            self.parts, self.target, tuple(self.inputs.shape[1:]), 0, self.columns
        ).eval()
        for part in predictor.modules():
            if isinstance(part, DensityHead):
                fit_if_needed(part, self.target)
        inputs = self.inputs.repeat(5, *[1] * (self.inputs.dim() - 1))
        with torch.no_grad():
            predictor.calibrate([{"input": inputs, "target": values(self.target, (20,))}])
        described = {
            "format": 1,
            "version": "1",
            "config": {**self.parts, "data": {"name": "moons"}},
            "target": {"kind": self.target.kind, "names": self.target.names, "size": self.target.size},
            "input_shape": self.inputs.shape[1:],
            "columns": self.columns,
            "synthetic": True,
        }
        OURS.update(path for path in paths_of(self.parts).values() if isinstance(path, str))
        state = {f"{loading.PREFIX}{name}": value for name, value in predictor.state_dict().items()}
        told = {"inputs": self.inputs, "answer": answer(predictor, self.target, self.inputs)}
        content = {"framework": described, "state_dict": state, TOLD: told}
        return written("a.ckpt", lambda file: WholeCheckpoints().save_checkpoint(content, file))


def answer(predictor: Predictor, target: Target, inputs: Tensor) -> Tensor:
    """Return the log-densities of random targets."""
    torch.manual_seed(SEED)
    with torch.no_grad():
        return predictor(inputs).log_prob(values(target, (len(inputs),)))


def of_head(name: str, row: HeadRow) -> Subject:
    config = resolve("density_head", {"name": name, **row.config})
    made = HeadSubject(
        row, lambda: fit_if_needed(build("density_head", config, target=row.target), row.target)
    )
    encoder = [resolve("encoder", SMALL)] if made.make().backbones else []
    return Subject(parts(encoder, config), row.target, made.raw_parameters(4))


def of_encoder(name: str, row: EncoderRow) -> Subject:
    config = resolve("encoder", {"name": name, **row.config})
    made = build("encoder", config, input_shape=row.input_shape, input_columns=row.columns)
    generator = torch.Generator().manual_seed(SEED)
    inputs = row.inputs(4) if row.inputs else torch.rand(4, *row.input_shape, generator=generator)
    chain = [config] if len(made.output_shape) == 1 else [config, resolve("encoder", SMALL)]
    return Subject(parts(chain, "categorical"), CLASSES, inputs, row.columns)


def of_wrapper(name: str, row: WrapperRow) -> Subject:
    inputs = torch.randn(4, 6, generator=torch.Generator().manual_seed(SEED))
    wrapper = resolve("uncertainty", {"name": name, **row.config})
    return Subject(parts([resolve("encoder", SMALL)], HEADS[row.target.kind], wrapper), row.target, inputs)


def parts(encoder: list[Any], head: Any, *uncertainty: Any) -> dict[str, Any]:
    return {"encoder": encoder, "density_head": resolve("density_head", head), "uncertainty": [*uncertainty]}


MAKERS: Mapping[str, Callable[[str, Any], Subject]] = {
    "density_head": of_head,
    "encoder": of_encoder,
    "uncertainty": of_wrapper,
}


@cache
def stored(group: str, name: str) -> tuple[bytes, ...]:
    """Return undamaged checkpoints for the rows of a plugin that store arrays and are not too large."""
    found = [] if name in HEAVY else [MAKERS[group](name, row) for row in contract(group, name).rows]
    made = [subject.checkpoint() for subject in found]
    return tuple(content for content in made if len(content) <= LARGEST and whole(content)["state_dict"])


def whole(content: bytes) -> dict[str, Any]:
    """Return the content of an undamaged checkpoint or file of weights."""
    return torch.load(io.BytesIO(content), weights_only=True)


# ---- what may be wrong with an array -------------------------------------------------------------------------------


class Forged:
    """Forged tensor with any offset, size and stride in its storage.

    Args:
        like: whose storage it is.
        offset, size, stride: in that.
    """

    def __init__(self, like: Tensor, offset: int, size: Sequence[int], stride: Sequence[int]) -> None:
        self.said = (torch.storage.TypedStorage(wrap_storage=like.untyped_storage(), dtype=like.dtype, _internal=True),
                     offset, tuple(size), tuple(stride), False, OrderedDict())  # fmt: skip

    def __reduce__(self) -> tuple[Callable[..., Tensor], tuple[Any, ...]]:
        return _rebuild_tensor_v2, self.said


def structured(array: Tensor, random: np.random.Generator) -> Any:
    """Return one of the other kinds of tensors that torch stores (sparse, nested, quantised, …), with invalid
    content."""
    flat = array.reshape(-1).float()
    far = torch.tensor([EXTREMES[int(random.integers(len(EXTREMES)))]])
    some = flat[:1] if len(flat) else torch.zeros(1)
    size: tuple[int, ...] = (max(len(flat), 1),)
    loose: dict[str, Any] = {"check_invariants": False}
    rows = torch.tensor([0, int(far), 1])
    kinds: list[Callable[[], Any]] = [
        lambda: array.to_sparse(),
        lambda: torch.sparse_coo_tensor(far[None], some, size, **loose),
        lambda: torch.sparse_csr_tensor(rows, far, some, (2, 2), **loose),
        lambda: torch.sparse_csc_tensor(rows, far, some, (2, 2), **loose),
        lambda: torch.sparse_bsr_tensor(rows, far, some.reshape(1, 1, 1), (2, 2), **loose),
        lambda: torch.nested.nested_tensor([some, some]),
        lambda: torch._nested_view_from_buffer(some, far[None], torch.ones(1, 1, dtype=torch.int64), far),
        lambda: torch.quantize_per_tensor(flat, 0.1, 0, torch.qint8),
        lambda: torch.quantize_per_channel(
            flat, torch.ones(len(flat)), torch.zeros(len(flat)), 0, torch.quint8
        ),
        lambda: torch.empty(array.shape, device="meta", dtype=array.dtype),
        lambda: array.to(torch.complex64).conj(),
        lambda: array.untyped_storage(),
        lambda: array.new_zeros(1).expand(max(2000, array.numel())),
        lambda: Forged(array, int(far), array.shape, array.stride()),
        lambda: Forged(array, 0, [*array.shape, int(far)], [*array.stride(), 0]),
        lambda: Forged(array, 0, [int(far)], [1]),
        lambda: Forged(array, 0, array.shape, [-1] * array.dim()),
        lambda: Forged(array, array.numel() + 1, array.shape, array.stride()),
        lambda: array.tolist(),
        lambda: None,
    ]
    try:
        return kinds[int(random.integers(len(kinds)))]()
    except RuntimeError:  # torch makes no such one of this array
        return array.to(torch.complex64)


def retyped(array: Tensor, random: np.random.Generator) -> Tensor:
    """Return the same numbers as another type."""
    return array.to(TYPES[int(random.integers(len(TYPES)))])


def reshaped(array: Tensor, random: np.random.Generator) -> Tensor:
    flat = array.reshape(-1)
    kinds = (
        flat[: int(random.integers(len(flat) + 1))],
        torch.cat([flat, flat[: int(random.integers(len(flat) + 1))]]),
        flat,
        array[None],
        array[..., None],
        array.new_zeros(0),
        array.new_zeros((0, *array.shape)),
        array.new_zeros(()),
        array.mT if array.dim() > 1 else flat,
        flat.repeat(int(random.integers(2, 50))),
    )
    return kinds[int(random.integers(len(kinds)))]


def revalued(array: Tensor, random: np.random.Generator) -> Tensor:
    """Replace numbers by extreme numbers, by cycles of indices, or by another order."""
    if array.dtype == torch.uint8 and array.dim() == 1:  # bytes of a format
        return torch.tensor(list(spoilt(array.numpy().tobytes(), random)), dtype=torch.uint8)
    found = array.clone(memory_format=torch.contiguous_format)
    flat = found.view(-1)
    if not len(flat):
        return found
    number = float if array.is_floating_point() else int
    limits = torch.finfo(array.dtype) if array.is_floating_point() else torch.iinfo(array.dtype)
    special = [number(limits.min), number(limits.max), -1, 0, 1, 2, len(flat), len(flat) - 1, len(flat) + 1]
    if isinstance(limits, torch.finfo):
        special += [torch.nan, torch.inf, -torch.inf, limits.tiny, -limits.tiny, limits.eps]
    value = special[int(random.integers(len(special)))]
    value = min(max(value, limits.min), limits.max) if value == value and abs(value) != torch.inf else value
    places = torch.from_numpy(random.integers(0, len(flat), int(random.integers(1, 4))))
    match int(random.integers(7)):
        case 0 | 1 | 2:
            flat[places] = value
        case 3:
            flat.fill_(value)
        case 4:
            flat.copy_(flat[torch.from_numpy(random.permutation(len(flat)))])
        case 5:  # each names itself, or one that names it
            flat.copy_((torch.arange(len(flat)) ^ int(random.integers(2))).clamp(max=min(limits.max, 2**53)))
        case 6:
            flat.copy_(flat.roll(int(random.integers(1, len(flat) + 1))))
    return found


EXTREMES = (-(2**63), -(2**31), -1, 0, 1, 2, 3, 1000, 2**20, 2**31 - 1, 2**31, 2**40, 2**62, 2**63 - 1)
TYPES = (
    torch.complex64,
    torch.complex128,
    torch.bool,
    torch.uint8,
    torch.int8,
    torch.int16,
    torch.int32,
    torch.int64,
)
TYPES += (torch.float16, torch.bfloat16, torch.float32, torch.float64)
KINDS: tuple[Callable[[Tensor, np.random.Generator], Any], ...] = (
    revalued,
    revalued,
    retyped,
    reshaped,
    structured,
)


def in_arrays(content: bytes, random: np.random.Generator) -> bytes:
    """A checkpoint, or a file of weights, with one array damaged; its checksum is right.

    The checkpoint records the required outcome: "any" prediction, the "same" prediction, or "refused".
    """
    trailed = content[-TRAILER:].startswith(checkpoints.MARK)
    values_of = whole(content)
    state = values_of["state_dict"]
    name = list(state)[int(random.integers(len(state)))]
    array = state[name]
    kind = KINDS[int(random.integers(len(KINDS)))]
    state[name] = kind(array, random)
    wanted = wanted_of(array, state[name], kind)
    values_of[TOLD] |= {"array": name, "kind": kind.__name__, "wanted": wanted}
    packed = saved(lambda stream: torch.save(values_of, stream))
    return packed + signature(packed) if trailed else packed


def wanted_of(array: Tensor, made: Any, kind: Callable[..., Any]) -> str:
    """Return the required outcome for an array that replaces another: "refused", "any" or the like."""
    if isinstance(made, Forged):
        try:
            made = whole(saved(lambda stream: torch.save({"state_dict": {"a": made}}, stream)))["state_dict"][
                "a"
            ]
        except RuntimeError:
            return "refused"
    dense = isinstance(made, Tensor) and made.layout == torch.strided and made.device == array.device
    if not dense or made.is_quantized or made.is_conj() or made.is_nested:
        return "refused"
    floating = made.is_floating_point() and array.is_floating_point()
    if made.dtype != array.dtype and not floating:
        return "refused"
    if made.shape != array.shape:
        return "any" if array.dtype == torch.uint8 and made.dim() == 1 else "refused"
    return "same" if kind is retyped and made.dtype.itemsize >= array.dtype.itemsize else "any"


def signature(packed: bytes) -> bytes:
    return signed(lambda content, _: content)(packed + bytes(TRAILER), np.random.default_rng())[len(packed) :]


# ---- readers ------------------------------------------------------------------------------------------------------


def states() -> Iterator[Reader]:
    """Yield readers that load a model with each plugin that stores arrays, and predict with it."""
    for group in MAKERS:
        for name in installed(group):
            yield Reader(
                f"arrays of {group} {name}",
                "model.ckpt",
                lambda group=group, name=name: stored(group, name),
                predicted,
                [in_arrays, in_arrays, in_arrays, signed(spoilt)],
                all_inner=True,
                share=0.1,
            )
    for data in DATA:
        yield Reader(
            f"data state of {data}",
            "model.ckpt",
            lambda data=data: [of_data(data)],
            asked,
            [in_data, in_data, signed(spoilt)],
            all_inner=True,
            share=0.1,
        )
    yield Reader(
        "weights, into a network", "one.pth", lambda: [weights()], filled, [in_arrays], all_inner=True
    )


def predicted(file: Path) -> object:
    """Load a stored model, and return its predictions."""
    content = checkpoints.read(file)
    predictor, description = loading.load_with_description(file, paths=said_again(content))
    told = content[TOLD] if isinstance(content.get(TOLD), dict) else {}
    found = None
    try:
        inputs = torch.rand(
            1, *description.input_shape
        )  # where the damage is in what was told; some heads fit to it
        given = told.get("inputs")
        if isinstance(given, Tensor) and given.shape == (4, *description.input_shape):
            inputs = given
        found = answer(predictor, description.target, inputs)
    except (NonFiniteParameters, UserError) as error:  # a sentence, of numbers that no training gives
        raise DataError(f"{file}: {error}") from error
    finally:
        compare(told, found)
    if found is not None and "array" in told and found.isnan().any() and not told["answer"].isnan().any():
        raise Silent(f"NaN for {told['array']} ({told['kind']})")
    return found


def compare(told: Mapping[str, Any], found: Tensor | None) -> None:
    """Raises: Silent: what was damaged is taken as if it were whole."""
    if told.get("wanted") == "refused":
        raise Silent(f"{told['array']} is taken ({told['kind']})")
    if told.get("wanted") == "same" and not torch.equal(
        found if found is not None else torch.zeros(0), told["answer"]
    ):
        raise Silent(f"other numbers of {told['array']} ({told['kind']})")


def said_again(content: Mapping[str, Any]) -> dict[str, Any]:
    """Return the paths in the config of a row's model, which the user must name again to load the model."""
    with contextlib.suppress(Exception):  # of a damaged config
        return {key: path for key, path in paths_of(content["framework"]["config"]).items() if path in OURS}
    return {}


def network() -> nn.Module:
    torch.manual_seed(SEED)
    return nn.Sequential(nn.Linear(3, 4), nn.BatchNorm1d(4)).eval()


def weights() -> bytes:
    with torch.no_grad():
        told = {"answer": network()(torch.ones(2, 3))}
    return saved(lambda stream: torch.save({"state_dict": network().state_dict(), TOLD: told}, stream))


def filled(file: Path) -> object:
    """Fill a network with the weights of a file, and compare its outputs with the stored outputs."""
    made = network()
    fill_from_file(made, str(file), ignored=())
    told = torch.load(file, weights_only=True)[TOLD]
    with torch.no_grad():
        compare(told, made(torch.ones(2, 3)))
    return made


DATA: Mapping[str, Mapping[str, Any]] = {
    "tabular": {"columns": ["x", "y"], "largest": [2.0, 3.0], "mean": [0.1, 0.2], "deviation": [0.5, 0.6]},
    "human_scans": {"height": 16, "width": 12},
}
"""Data sets that store a state with a model."""
ODD = (
    None,
    -1,
    0,
    1,
    7,
    10**9,
    2**63,
    10**400,
    0.0,
    0.5,
    -0.5,
    float("nan"),
    float("inf"),
    1e308,
    5e-324,
    True,
)
ODD += ("x" * 5000, "\x1b[2J", [], {}, [[]], [1.0], [1.0, 2.0, 3.0], (1.0, float("nan")), torch.zeros(2), 1j)


def of_data(name: str) -> bytes:
    """Return the checkpoint of a model of two numbers that was trained on such data."""
    subject = Subject(
        parts([resolve("encoder", SMALL)], "categorical"), CLASSES, torch.zeros(4, 2), ("x", "y")
    )
    content = whole(subject.checkpoint())
    content["framework"] |= {"data_state": dict(DATA[name])}
    content["framework"]["config"]["data"] = resolve("data", name)
    return written("a.ckpt", lambda file: WholeCheckpoints().save_checkpoint(content, file))


def in_data(content: bytes, random: np.random.Generator) -> bytes:
    """Remove or replace one value of the stored state of the data in a checkpoint."""
    values_of = whole(content)
    place: Any = values_of["framework"]["data_state"]
    while True:
        keys = list(place) if isinstance(place, dict) else list(range(len(place)))
        key = keys[int(random.integers(len(keys)))]
        if not isinstance(place[key], list) or random.random() < 0.3:
            break
        place = place[key]
    if random.random() < 0.2:
        del place[key]
    else:
        place[key] = ODD[int(random.integers(len(ODD)))]
    packed = saved(lambda stream: torch.save(values_of, stream))
    return packed + signature(packed)


def asked(file: Path) -> object:
    """Load a stored model, and return its log-densities for raw input."""
    predictor = loading.load(file)
    data = loading.reader(loading.read_stored(file)[0])
    try:
        if "height" in data.state_dict():
            data.preview(torch.zeros(3, 6))
        return predictor(np.ones((2, 2), np.float32)).log_prob(torch.zeros(2, dtype=torch.int64))
    except (NonFiniteParameters, UserError) as error:
        raise DataError(f"{file}: {error}") from error
