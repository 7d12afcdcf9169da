import json
import math
import random
import struct
import zipfile

import pytest
import torch
from safetensors.torch import save_file
from torch import nn

from framework.errors import CheckpointError, ConfigError
from framework.storage.weights import FINITE, FROM_0, LARGEST, fill_from_file, read_weights, require_state


def network():
    return nn.Sequential(nn.Conv2d(2, 3, 1, bias=False), nn.BatchNorm2d(3))


def state():
    torch.manual_seed(0)
    found = network().state_dict()
    return {
        name: torch.randn_like(tensor) if tensor.is_floating_point() else tensor
        for name, tensor in found.items()
    }


def safetensors(tensors, **changed):
    """Return the bytes of a .safetensors file, written from the specification of the format."""
    kinds = {torch.float32: "F32", torch.float16: "F16", torch.bfloat16: "BF16", torch.int64: "I64"}
    header, body = {"__metadata__": {"format": "pt"}}, b""
    for name, tensor in tensors.items():
        data = bytes(tensor.contiguous().flatten().view(torch.uint8).tolist())
        offsets = [len(body), len(body) + len(data)]
        header[name] = {
            "dtype": kinds[tensor.dtype],
            "shape": list(tensor.shape),
            "data_offsets": offsets,
            **changed,
        }
        body += data
    text = json.dumps(header).encode()
    return struct.pack("<Q", len(text)) + text + body


@pytest.mark.parametrize("wrap", [lambda state: state, lambda state: {"state_dict": state, "epoch": 3}])
@pytest.mark.parametrize("prefix", ["", "module."])
@pytest.mark.parametrize("legacy", [False, True])
def test_what_torch_saves_is_read(tmp_path, wrap, prefix, legacy):
    file = tmp_path / "weights.pth"
    named = {prefix + name: tensor for name, tensor in state().items()}
    torch.save(wrap(named), file, _use_new_zipfile_serialization=not legacy)
    filled = network()
    fill_from_file(filled, str(file), ignored=("classif.",))
    for name, tensor in filled.state_dict().items():
        assert torch.equal(tensor, state()[name])


def test_safetensors_are_read(tmp_path):
    file = tmp_path / "weights.safetensors"
    tensors = state() | {
        "half": torch.tensor([[1.5, -2.0]], dtype=torch.float16),
        "brain": torch.tensor(3.0, dtype=torch.bfloat16),
        "empty": torch.zeros(0, 4),
    }
    file.write_bytes(safetensors(tensors))
    found = read_weights(str(file))
    assert found.keys() == tensors.keys()
    for name, tensor in found.items():
        assert tensor.dtype == tensors[name].dtype
        assert torch.equal(tensor, tensors[name])


def test_half_precision_is_widened_and_a_missing_counter_is_no_fault(tmp_path):
    file = tmp_path / "weights.pt"
    torch.save({name: tensor.half() for name, tensor in state().items() if "batches" not in name}, file)
    filled = network()
    fill_from_file(filled, str(file), ignored=("classif.",))
    assert filled[0].weight.dtype == torch.float32
    assert torch.equal(filled[0].weight, state()["0.weight"].half().float())


def test_the_classifier_is_left_out_and_said_to_be(tmp_path, caplog):
    file = tmp_path / "weights.pth"
    torch.save(state() | {"classif.weight": torch.zeros(1000, 4)}, file)
    with caplog.at_level("INFO", "framework.storage.weights"):
        fill_from_file(network(), str(file), ignored=("classif.",))
    assert "does not use these weights" in caplog.text and "classif.weight" in caplog.text


def test_the_network_may_be_a_part_of_the_one_in_the_file(tmp_path):
    file = tmp_path / "weights.pth"
    torch.save(
        {"features." + name: tensor for name, tensor in state().items()} | {"top.bias": torch.zeros(1)}, file
    )
    filled = network()
    fill_from_file(filled, str(file), ignored=("top.",), within="features.")
    assert all(torch.equal(tensor, state()[name]) for name, tensor in filled.state_dict().items())


@pytest.mark.parametrize(
    "change, said",
    [
        (lambda found: found.pop("1.bias"), "1 of 6 weights are missing: 1.bias"),
        (lambda found: found.update(extra=torch.zeros(1)), "weights of the file are unknown: extra"),
        (lambda found: found.update({"0.weight": torch.zeros(3, 9, 1, 1)}), "have another shape: 0.weight"),
        *(
            (
                lambda found, kind=kind: found.update({"0.weight": found["0.weight"].to(kind)}),
                rf"of another type: 0\.weight \({str(kind)[6:]} instead of float32\)",
            )
            for kind in (torch.complex64, torch.bool, torch.int32, torch.uint8)
        ),
        (
            lambda found: found.update({"1.num_batches_tracked": torch.tensor(1.0)}),
            r"another type: 1\.num_batches_tracked \(float32 instead of int64\)",
        ),
    ],
)
def test_says_what_does_not_fit_and_changes_nothing(tmp_path, change, said):
    file = tmp_path / "weights.pth"
    found = state()
    change(found)
    torch.save(found, file)
    filled = network()
    before = {name: tensor.clone() for name, tensor in filled.state_dict().items()}
    with pytest.raises(CheckpointError, match=said):
        fill_from_file(filled, str(file), ignored=("classif.",))
    assert all(torch.equal(tensor, before[name]) for name, tensor in filled.state_dict().items())


def test_says_when_there_is_no_file(tmp_path):
    with pytest.raises(ConfigError, match=r"The weight file .* does not exist\. Weights are not downloaded"):
        read_weights(str(tmp_path / "weights.pth"))


@pytest.mark.parametrize("content", [{}, {"a": 1}, [torch.zeros(2)], torch.zeros(2), {"state_dict": {}}])
def test_refuses_a_file_without_named_tensors(tmp_path, content):
    file = tmp_path / "weights.pth"
    torch.save(content, file)
    with pytest.raises(CheckpointError, match="contains no named tensors"):
        read_weights(str(file))


class Trap:
    def __reduce__(self):
        return print, ("this must not run",)


def test_refuses_what_could_run_code(tmp_path, capsys):
    file = tmp_path / "weights.pth"
    torch.save({"weight": Trap()}, file)
    with pytest.raises(CheckpointError, match="contains more than plain tensors"):
        read_weights(str(file))
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize("name", ["weights.pth", "weights.safetensors"])
@pytest.mark.parametrize("kept", [0, 5, 0.5, -1])
def test_refuses_a_file_cut_short(tmp_path, name, kept):
    file = tmp_path / name
    if name.endswith("pth"):
        torch.save(state(), file)
    else:
        file.write_bytes(safetensors(state()))
    data = file.read_bytes()
    file.write_bytes(data[: int(len(data) * kept) if isinstance(kept, float) else kept])
    with pytest.raises(CheckpointError, match=r"damaged|contains more than plain tensors"):
        read_weights(str(file))


def test_any_damage_is_refused_or_harmless(tmp_path):
    file = tmp_path / "weights.pth"
    torch.save(state(), file)
    whole = file.read_bytes()
    generator = random.Random(0)
    refused = 0
    for _ in range(300):
        data = bytearray(whole)
        data[generator.randrange(len(data))] ^= 1 << generator.randrange(8)
        file.write_bytes(data)
        try:
            found = read_weights(str(file))
        except CheckpointError:
            refused += 1
        else:  # the bit was in padding or a time stamp
            assert all(torch.equal(tensor, found[name]) for name, tensor in state().items())
    assert 150 < refused < 300


def test_refuses_a_flipped_bit_in_a_number(tmp_path):
    file = tmp_path / "weights.pth"
    torch.save({"weight": torch.arange(64.0)}, file)
    data = bytearray(file.read_bytes())
    with zipfile.ZipFile(file) as archive:
        inside = next(info for info in archive.infolist() if info.filename.endswith("data/0"))
    at = data.index(struct.pack("<f", 37.0), inside.header_offset)
    data[at] ^= 0x10
    file.write_bytes(data)
    with pytest.raises(CheckpointError, match="fails its checksum"):
        read_weights(str(file))


@pytest.mark.parametrize(
    "changed",
    [
        {"dtype": "C64"},
        {"shape": [1 << 40]},
        {"shape": [-1, -3]},
        {"data_offsets": [-4, 4]},
        {"data_offsets": [0, 1 << 40]},
        {"data_offsets": [0]},
    ],
)
def test_refuses_a_header_that_lies(tmp_path, changed):
    file = tmp_path / "weights.safetensors"
    file.write_bytes(safetensors({"weight": torch.zeros(3)}, **changed))
    with pytest.raises(CheckpointError, match="damaged"):
        read_weights(str(file))


def test_a_further_key_of_a_header_changes_nothing(tmp_path):
    file = tmp_path / "weights.safetensors"
    file.write_bytes(safetensors({"weight": torch.arange(3.0)}, more=1))
    assert read_weights(str(file))["weight"].tolist() == [0, 1, 2]


@pytest.mark.parametrize("kind", [torch.complex64, torch.uint8, torch.bool])
def test_refuses_numbers_that_are_no_weights(tmp_path, kind):
    save_file({"weight": torch.zeros(3, dtype=kind)}, tmp_path / "weights.safetensors")
    with pytest.raises(CheckpointError, match=f"weight has numbers of type {kind}; expected torch.float64"):
        read_weights(str(tmp_path / "weights.safetensors"))


class Calibrated(nn.Module):
    """Module with a fitted buffer."""

    def __init__(self, values, bounds):
        super().__init__()
        self.register_buffer("fitted", torch.tensor(values, dtype=torch.float64))
        require_state(self, fitted=bounds)


@pytest.mark.parametrize("shape", [(), (3,)])
@pytest.mark.parametrize("bounds", [(1e-300, LARGEST), FROM_0, FINITE, (-math.inf, math.inf), (-2.0, 0.5)])
def test_a_stored_buffer_is_taken_within_its_bounds_only(bounds, shape):
    """NaN, other shapes and other types are refused; a single number must not be a row of one."""
    whole = torch.full(shape, 0.25, dtype=torch.float64)
    holder = nn.Sequential(Calibrated(whole.tolist(), bounds))
    for value in (-math.inf, -1e300, -1.0, 0.0, 0.5, 1e300, math.inf, math.nan):
        state = {"0.fitted": whole.clone()}
        state["0.fitted"].view(-1)[-1:] = value
        if bounds[0] <= value <= bounds[1]:
            holder.load_state_dict(state)
            assert torch.equal(holder[0].fitted, state["0.fitted"])
            holder.load_state_dict({"0.fitted": whole})
        else:
            with pytest.raises(
                CheckpointError, match="Calibrated is damaged: fitted has numbers that are not between"
            ):
                holder.load_state_dict(state)
    for wrong in (whole[None], whole[..., None], whole.bool(), whole.to(torch.complex128), whole.tolist()):
        with pytest.raises(CheckpointError, match=r"Calibrated is damaged: .* fitted "):
            holder.load_state_dict({"0.fitted": wrong})
    assert torch.equal(holder[0].fitted, whole)
    with pytest.raises(RuntimeError, match="Missing key"):
        holder.load_state_dict({})
