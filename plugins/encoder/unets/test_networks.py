import pytest
import torch
from torch.nn import functional

from framework.configuration.schema import build, resolve
from framework.errors import ConfigError
from framework.storage.processor import fast_bfloat16
from plugins.encoder.unets.canvas import EMPTY_LOG_SCALE
from plugins.encoder.unets.layers import EPSILON, Layer

SMALL = {"unet": {"width": 4, "levels": 3}, "slim": {"widths": [6, 8, 10]}}
STRIDE = {"unet": 4, "slim": 8}


def build_network(name, shape, **config):
    """Return a network in evaluation, with random running moments, gains and offsets."""
    torch.manual_seed(0)
    network = build("encoder", resolve("encoder", {"name": name, **SMALL[name], **config}), input_shape=shape)
    with torch.no_grad():
        for key, value in network.state_dict().items():
            if key.endswith(("gain", "variance")):
                value.uniform_(0.5, 2)
            elif key.endswith(("offset", "mean", "bias")):
                value.normal_(0, 0.5)
    return network.eval()


def images(count, shape, *boxes):
    """Return images with random pixels in a box (top, bottom, left, right) each and 1 elsewhere.

    All images after the last box have that box.
    """
    generator = torch.Generator().manual_seed(1)
    batch = torch.ones(count, *shape)
    for index in range(count):
        top, bottom, left, right = boxes[min(index, len(boxes) - 1)]
        part = batch[index, :, top:bottom, left:right]
        part.copy_(torch.rand(part.shape, generator=generator))
    return batch


class Plain:
    """The networks in their textbook form, on unchanged images.

    `white`, (1, channels, 1, 1), is the value of a layer in the middle of an image of ones. Maps are padded with this
    value, and running moments are those of differences from it.
    """

    def __init__(self, network, name):
        self.state, self.name, self.step = network.state_dict(), name, 0

    def compute(self, inputs, colors):
        height, width = inputs.shape[2:]
        stride = STRIDE[self.name]
        image = functional.pad(inputs, (0, -width % stride, 0, -height % stride), value=1.0)
        maps, white = (self.unet if self.name == "unet" else self.slim)(
            image, torch.ones_like(image[:1, :, :1, :1])
        )
        kernel = self.state["head.weight"]
        around = kernel.shape[-1] // 2
        raw = functional.conv2d(pad_maps(maps - white, 0 * white, around), kernel, self.state["head.bias"])
        raw = functional.pixel_shuffle(raw, 1 if self.name == "unet" else 2)[..., :height, :width]
        return torch.cat([(6 * (1 + raw[:, :colors])).sigmoid(), raw[:, colors:]], 1)

    def layer(self, maps, white):
        weight, mean, variance, gain, offset = (
            self.state[f"layers.{self.step}.{part}"]
            for part in ("weight", "mean", "variance", "gain", "offset")
        )
        self.step += 1
        stride, around = (2, 0) if weight.shape[-1] == 2 else (1, 1)
        raw = functional.conv2d(pad_maps(maps, white, around), weight, stride=stride)
        ground = functional.conv2d(white.expand(-1, -1, *weight.shape[2:]), weight)
        moments = (mean + ground[0, :, 0, 0], variance)
        return (
            functional.batch_norm(part, *moments, gain, offset, eps=EPSILON).relu() for part in (raw, ground)
        )

    def double_size(self, maps, white):
        wide = functional.interpolate(pad_maps(maps, white, 1), scale_factor=2, mode="bilinear")
        return wide[..., 2:-2, 2:-2], white

    def unet(self, maps, white):
        across = []
        for level in range(3):
            maps = functional.max_pool2d(maps, 2) if level else maps
            maps, white = self.layer(*self.layer(maps, white))
            across.append((maps, white))
        for same_size in (across[1], across[0]):
            both = zip(same_size, self.layer(*self.double_size(maps, white)), strict=True)
            maps, white = self.layer(*self.layer(*(torch.cat(pair, 1) for pair in both)))
        return maps, white

    def slim(self, maps, white):
        maps, white = self.layer(functional.pixel_unshuffle(maps, 2), white.repeat_interleave(4, 1))
        across = [(maps, white)]
        for _ in range(2):
            maps, white = self.layer(*self.layer(maps, white))
            across.append((maps, white))
        for same_size in (across[1], across[0]):
            maps, white = self.layer(maps, white)
            kernel = torch.ones(maps.shape[1], 1, 2, 2).to(maps)
            spread = functional.conv_transpose2d(maps, kernel, stride=2, groups=len(kernel))
            maps, white = same_size[0] + spread, same_size[1] + white
        return self.layer(maps, white)


def pad_maps(maps, white, around):
    return functional.pad(maps - white, (around,) * 4) + white


@pytest.mark.parametrize("dtype, limit", [(torch.float32, 1e-5), (torch.float64, 1e-13)])
@pytest.mark.parametrize("size", [(13, 10), (16, 24), (1, 1), (1, 9)])
@pytest.mark.parametrize("name", SMALL)
def test_agrees_with_a_plain_network(name, size, dtype, limit):
    """Compare networks with folded normalisation with `Plain`, for images of any size."""
    network = build_network(name, (4, *size), scales=3, crop=None).to(dtype)
    inputs = images(3, (4, *size), (0, 1, 0, 5), (0, 0, 0, 0), (0, *size, 0)[:0] or (0, size[0], 0, size[1]))
    output = network(inputs.to(dtype))
    assert output.shape == (3, 6, *size)
    wanted = Plain(network, name).compute(inputs.to(dtype), 3)
    assert wanted.std() > 0.01
    torch.testing.assert_close(output, wanted, rtol=limit, atol=limit)


@pytest.mark.parametrize("normalisation", ["batch", "renorm"])
@pytest.mark.parametrize("size", [3, 2])
def test_a_layer_in_training_is_normalised_as_published(normalisation, size):
    """Compare with Ioffe 2017, Algorithm 1, with running moments from the previous batches."""
    torch.manual_seed(0)
    layer = Layer(3, 5, size, normalisation).double()
    gain, offset = layer.gain.data.uniform_(0.5, 2), layer.offset.data.normal_()
    stride, around = (2, 0) if size == 2 else (1, 1)
    moments_of_batches = []
    for number in range(4):
        maps = torch.randn(4, 3, 8, 8).double() * (1 + 3 * number)
        raw = functional.conv2d(maps, layer.weight, stride=stride, padding=around).transpose(0, 1)
        mean, variance = raw.flatten(1).mean(1), raw.flatten(1).var(1, correction=0)
        deviation = (variance + EPSILON).sqrt()
        ratio, moved = torch.ones(5).double(), torch.zeros(5).double()
        if (
            normalisation == "renorm" and moments_of_batches
        ):  # at first the moments are the mean of all batches
            usual = (torch.stack([spread for _, spread in moments_of_batches]).mean(0) + EPSILON).sqrt()
            ratio = (deviation / usual).clamp(1 / 3, 3)
            moved = (
                (mean - torch.stack([middle for middle, _ in moments_of_batches]).mean(0)) / usual
            ).clamp(-5, 5)
        columns = (mean, deviation, ratio, moved, gain, offset)
        m, d, r, b, g, o = (column.detach()[:, None, None, None] for column in columns)
        wanted = (((raw - m) / d * r + b) * g + o).relu() - ((-m / d * r + b) * g + o).relu()
        torch.testing.assert_close(layer(maps), wanted.transpose(0, 1))
        moments_of_batches.append((mean.detach(), variance.detach()))


@pytest.mark.parametrize("normalisation", ["batch", "renorm", "group"])
def test_gradients_of_a_layer_in_training(normalisation):
    """Compare gradients with finite differences; the correction of `renorm` is a constant by definition."""
    torch.manual_seed(0)
    layer = Layer(2, 4, 3, normalisation).double()
    maps = torch.randn(2, 2, 4, 4).double()
    if normalisation == "renorm":
        layer(maps)
        layer.batches.zero_()  # a first batch again, so that there is no correction
    parts = [maps.requires_grad_(), *layer.parameters()]

    def evaluate(maps, *parameters):
        names = [name for name, _ in layer.named_parameters()]
        state = dict(zip(names, parameters, strict=True))
        if normalisation != "group":
            state["batches"] = torch.tensor(0)
        return torch.func.functional_call(layer, state, (maps,))

    assert torch.autograd.gradcheck(evaluate, parts)


@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
@pytest.mark.parametrize("middle", [0.0, 1e4])
def test_moments_keep_their_digits_wherever_channels_lie(middle, layout):
    torch.manual_seed(0)
    layer = Layer(4, 4, 3, "batch")
    maps = (torch.randn(4, 4, 64, 48) + middle).contiguous(memory_format=layout)
    layer._normalise(maps)
    wanted = maps.double().var((0, 2, 3), correction=0)
    torch.testing.assert_close(layer.variance.double(), wanted, rtol=1e-5, atol=0)
    torch.testing.assert_close(layer.mean.double(), maps.double().mean((0, 2, 3)), rtol=1e-6, atol=1e-6)


def test_group_norm_is_torchs():
    torch.manual_seed(0)
    network = build(
        "encoder",
        resolve("encoder", {"name": "slim", "normalisation": "group", "crop": None}),
        input_shape=(4, 8, 8),
    )
    layer = network.layers[0]
    maps = torch.randn(2, 16, 6, 7)
    raw = functional.conv2d(maps, layer.weight, padding=1)
    padded = functional.group_norm(raw, 8, layer.gain, layer.offset)
    output = layer(maps)
    change = (
        output.flatten(2).diff() - padded.relu().flatten(2).diff()
    )  # equal up to one constant per channel
    assert change.abs().max() < 1e-5
    torch.testing.assert_close(layer.fold(torch.float32)(maps), output)


@pytest.mark.parametrize("name", SMALL)
def test_an_empty_ground_stays_empty_in_every_layer(name):
    network = build_network(name, (4, 21, 18), scales=1, crop=None)
    output = network(torch.ones(1, 4, 21, 18))
    side = network.canvas.shuffle
    assert torch.equal(output, output[..., :side, :side].repeat(1, 1, 21, 18)[..., :21, :18])
    assert torch.equal(network(torch.full((1, 4, 21, 18), 255, dtype=torch.uint8)), output)


@pytest.mark.parametrize("name", SMALL)
def test_an_untrained_network_sees_white_in_an_empty_picture(name):
    torch.manual_seed(0)
    network = build("encoder", resolve("encoder", {"name": name, "scales": 1}), input_shape=(4, 30, 20))
    for output in (network(torch.ones(2, 4, 30, 20)), network.eval()(torch.ones(2, 4, 30, 20))):
        assert (output[:, :3] - 1).abs().max() < 1 / 255
        assert (output[:, 3] == EMPTY_LOG_SCALE).all()


@pytest.mark.parametrize("change", ["data", "load", "step", "swap"])
def test_nothing_is_kept_of_weights_that_have_changed(change):
    network, other = build_network("slim", (3, 9, 9)), build_network("slim", (3, 9, 9))
    with torch.no_grad():
        for value in other.state_dict().values():
            if value.is_floating_point():
                value.mul_(1.25)
    inputs = images(1, (3, 9, 9), (1, 6, 2, 7))
    keys, before = list(network.state_dict()), network(inputs)
    if change == "data":
        for mine, theirs in zip(
            [*network.parameters(), *network.buffers()], [*other.parameters(), *other.buffers()], strict=True
        ):
            mine.data.copy_(theirs)
    elif change == "load":
        network.load_state_dict(other.state_dict())
    elif change == "step":
        optimizer = torch.optim.SGD(network.parameters(), lr=0.5)
        network(inputs).square().sum().backward()
        optimizer.step()
        other.load_state_dict(network.state_dict())
    else:
        network.layers, network.head = other.layers, other.head
    assert list(network.state_dict()) == keys
    assert torch.equal(network(inputs), other(inputs))
    assert not torch.equal(network(inputs), before)


@pytest.mark.parametrize("name", SMALL)
def test_bfloat16_is_near_and_leaves_training_and_float64_alone(name):
    shape = (4, 33, 20)
    inputs = images(2, shape, (4, 30, 5, 15))
    exact, fast = build_network(name, shape), build_network(name, shape, precision="bfloat16")
    difference = (fast(inputs) - exact(inputs)).abs().max()
    assert 0 < difference < 0.05
    assert fast(inputs).dtype == torch.float32
    chosen = fast if fast_bfloat16(inputs.device) else exact
    assert torch.equal(build_network(name, shape, precision="auto")(inputs), chosen(inputs))
    assert torch.equal(fast.double()(inputs), exact.double()(inputs))
    assert torch.equal(fast.float().train()(inputs), exact.float().train()(inputs))


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("shape", [(5,), (3, 0, 4), (0, 4, 4), (3, 4, 0), (2, 3, 4, 4)])
def test_what_is_no_image_is_refused(name, shape):
    with pytest.raises(ConfigError, match=rf"{name} reads images of shape \(channels, height, width\)"):
        build_network(name, shape)


@pytest.mark.parametrize(
    "name, config",
    [
        ("unet", {"width": 0}),
        ("unet", {"levels": 0}),
        ("unet", {"colors": 0}),
        ("unet", {"scales": 2}),
        ("unet", {"normalisation": "layer"}),
        ("slim", {"widths": []}),
        ("slim", {"widths": [8, 0]}),
        ("slim", {"unshuffle": 0}),
        ("slim", {"crop": -1}),
        ("slim", {"precision": "float16"}),
    ],
)
def test_a_config_out_of_range_is_refused(name, config):
    with pytest.raises(ConfigError, match=r"encoder\."):
        resolve("encoder", {"name": name, **config})


def test_the_reference_has_the_published_size():
    """Check channels 32 to 512 at five levels, and the number of convolutions and parameters."""
    torch.manual_seed(0)
    network = build("encoder", resolve("encoder", {"name": "unet"}), input_shape=(4, 410, 308))
    assert [layer.weight.shape[0] for layer in network.layers][:10] == [
        32,
        32,
        64,
        64,
        128,
        128,
        256,
        256,
        512,
        512,
    ]
    assert len(network.layers) == 2 * 5 + 3 * 4
    assert sum(parameter.numel() for parameter in network.parameters()) == pytest.approx(8.64e6, rel=0.01)


@pytest.mark.parametrize("name", SMALL)
def test_a_residual_network_answers_its_input_until_it_has_learnt(name):
    """Check the output before training, and that the output of the last convolution is added to the input."""
    config = resolve("encoder", {"name": name, **SMALL[name], "residual": True, "scales": 1})
    network = build("encoder", config, input_shape=(4, 21, 18))
    image = images(2, (4, 21, 18), (5, 12, 3, 9), (0, 0, 0, 0))
    for training in (True, False):
        network.train(training)
        with torch.no_grad():
            output = network(image)
        torch.testing.assert_close(output[:, :3], image[:, :3], rtol=0, atol=1e-6)
        assert (output[:, 3] == EMPTY_LOG_SCALE).all()
    with torch.no_grad():
        network.head.bias.fill_(-0.25)
        torch.testing.assert_close(network(image)[:, :3], image[:, :3] - 0.25)
    with pytest.raises(
        ConfigError, match=r"residual=true adds to 3 colours of the input, but the input has 2 channels"
    ):
        build("encoder", config, input_shape=(2, 21, 18))
