import pytest
import torch

from plugins.encoder.unets.canvas import Box, Canvas, subject_box
from plugins.encoder.unets.test_networks import SMALL, build_network, images

SHAPE = (4, 203, 150)
SUBJECTS = {
    "middle": (90, 110, 70, 78),
    "corner": (0, 20, 130, 150),
    "border": (150, 203, 20, 30),
    "one pixel": (7, 8, 149, 150),
    "everything": (0, 203, 0, 150),
    "nothing": (0, 0, 0, 0),
}
REACH = 64
"""Largest distance, pixels, at which a pixel of a small network affects a map of any level: 33 (unet), 55 (slim)."""


@pytest.mark.parametrize("box", SUBJECTS.values(), ids=SUBJECTS)
@pytest.mark.parametrize("name", SMALL)
def test_with_a_margin_as_wide_as_a_pixel_acts_it_is_the_whole_frame(name, box):
    inputs = images(1, SHAPE, box)
    whole, cropped = (
        build_network(name, SHAPE, crop=None, scales=3),
        build_network(name, SHAPE, crop=REACH, scales=3),
    )
    torch.testing.assert_close(cropped(inputs), whole(inputs), rtol=0, atol=1e-5)
    assert (cropped.report.left_out > 0) == (box != SUBJECTS["everything"])
    assert whole.report is None


@pytest.mark.parametrize("name", SMALL)
def test_a_sample_does_not_see_its_batch_and_the_report_counts(name):
    network = build_network(name, SHAPE, crop=5, scales=1)
    boxes = list(SUBJECTS.values())
    inputs = images(len(boxes), SHAPE, *boxes)
    together, report = network(inputs), network.report
    stride = network.canvas.stride
    computed, inside = 0, 0
    for index, (box, output) in enumerate(zip(boxes, together, strict=True)):
        assert torch.equal(network(inputs[index : index + 1])[0], output)
        computed_box = network.report.boxes[0]
        assert report.boxes[index] == computed_box
        rest = torch.ones(SHAPE[1:], dtype=torch.bool)
        if box[1] == 0:
            assert computed_box is None
        else:
            wanted = []
            for first, last, side in ((*box[:2], SHAPE[1]), (*box[2:], SHAPE[2])):
                wanted += [max(0, first - 5) // stride * stride, -(-min(side, last + 5) // stride) * stride]
            assert computed_box == Box(*wanted)
            computed += (computed_box.bottom - computed_box.top) * (computed_box.right - computed_box.left)
            rest[computed_box.top : computed_box.bottom, computed_box.left : computed_box.right] = False
        inside += int((~rest).sum())
        empty = network(torch.ones(1, *SHAPE))[0]
        assert torch.equal(output[:, rest], empty[:, rest])
    assert (report.computed, report.left_out) == (computed, inputs[:, 0].numel() - inside)


@pytest.mark.parametrize("name", SMALL)
def test_gradients_are_those_of_the_whole_frame(name):
    def slopes(crop):
        network = build_network(name, SHAPE, crop=crop).double()
        inputs = images(2, SHAPE, SUBJECTS["middle"], SUBJECTS["corner"]).double().requires_grad_()
        network(inputs)[:, :, 10:180:3].square().sum().backward()
        return [parameter.grad for parameter in network.parameters()], inputs.grad * (inputs != 1)

    torch.testing.assert_close(slopes(REACH), slopes(None))


def test_training_computes_everything_and_says_so():
    network = build_network("slim", SHAPE, crop=0)
    network(torch.ones(1, *SHAPE))
    assert network.report.computed == 0
    network.train()(torch.ones(2, *SHAPE))
    assert network.report is None


def test_what_is_not_finite_is_not_empty():
    image = torch.ones(2, 9, 9)
    image[0, 3, 5] = torch.nan
    image[1, 4, 5] = -torch.inf
    assert subject_box(image, 1, 0) == Box(3, 5, 5, 6)
    assert subject_box(torch.ones(2, 9, 9), 1, 3) is None


def test_margin_and_stride_keep_to_the_frame():
    image = torch.ones(1, 10, 10)
    image[0, 9, 0] = 0
    assert subject_box(image, 4, 1) == Box(8, 12, 0, 4)
    assert subject_box(image, 4, 100) == Box(0, 12, 0, 12)
    assert Canvas(3, 4, 1, "float32").shuffle == 1
