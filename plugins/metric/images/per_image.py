"""Base class of metrics that evaluate single images: results of each image, their means, and a figure of examples."""

import math
from abc import abstractmethod
from typing import TYPE_CHECKING, ClassVar

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.errors import DataError
from framework.figures.chosen_images import choose_images
from framework.geometry.srgb import bytes_from_linear
from framework.metric import HasFigure, Metric
from framework.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure


class PerImage(Metric, HasFigure):
    """Base class of metrics that evaluate images one by one, in the channel that `reads` names, by default the colours.

    `judge` returns the numbers of one image; images are ranked by the first number. A number is NaN if it is not
    defined for an image; mean and standard error are over the other images. The metric keeps the numbers of all images,
    and at most KEPT + 2 images. Images are evaluated one by one, so that the batch size changes neither the result nor
    the required memory.

    Raises:
        DataError: a batch has no true image; or predicted and true images do not fit together, or contain NaN.
    """

    reads: ClassVar[frozenset[str]] = frozenset({"color"})
    keys: tuple[str, ...]
    """Names of the numbers that `judge` returns, in the same order."""
    masked: bool
    """True if `judge` receives the true masks."""
    numbers: list[Tensor]
    pairs: list[Tensor]
    facts: list[Tensor]

    def start(self, *keys: str, masked: bool = False) -> None:
        """Declare the metric's states; the constructor of a subclass calls this method.

        Args:
            keys: names of the numbers that `judge` returns, in the same order.
            masked: whether `judge` receives the true masks.
        """
        self.keys, self.masked = keys, masked
        self.columns = {key: heading for key, heading in self.columns.items() if key in keys}  # type: ignore[misc]
        self.better = {key: way for key, way in self.better.items() if key in keys}  # type: ignore[misc]
        # shapes: numbers (image, key); stored pair (1, predicted or true, height, width[, channel]); its facts (1, 2)
        for name in ("numbers", "pairs", "facts"):
            self.add_state(name, [], dist_reduce_fx="cat")

    @abstractmethod
    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        """Return the numbers of one image, in the order of `keys`.

        Args:
            predicted: the predicted image, (height, width[, channel]).
            true: the true image, of the same shape.
            mask: the true mask, (height, width); None unless `masked`.
        """

    def update(self, prediction: Prediction) -> None:
        channel, name = self._channel, type(self).__name__
        predicted, true = prediction.image(channel), prediction.true_image(channel)
        check_images(channel, predicted, true, name)
        masks: list[Tensor | None] = [None] * len(true)
        if self.masked:
            if "mask" not in prediction.batch:
                raise DataError(
                    f"metric {name} with `masked: true` requires the batch field 'mask', but the batches have only "
                    f"{', '.join(prediction.batch)}. Set `masked` to false, or choose data with masks."
                )
            mask = prediction.true_image("mask")
            if mask.dtype != torch.bool or mask.shape != true.shape[:3]:
                raise DataError(
                    f"the true masks are {describe_tensor(mask)}, expected bool {tuple(true.shape[:3])}."
                )
            masks = list(mask)
        if len(true) == 0:
            return
        image_numbers = [
            torch.stack(self.judge(*inputs)) for inputs in zip(predicted, true, masks, strict=True)
        ]
        numbers = torch.stack(image_numbers).double()
        self.numbers.append(numbers)
        facts = torch.stack([numbers[:, 0], prediction.batch["index"].double()], -1)
        self._keep([*self.facts, *facts.split(1)], predicted, true)

    def _keep(self, facts: list[Tensor], predicted: Tensor, true: Tensor) -> None:
        """Choose which of the stored images and the images of a batch are kept for the figure.

        Args:
            facts: for each stored image and then for each image of the batch, its score and its index in the data set,
                (1, 2).
            predicted: predicted images of the batch.
            true: true images of the batch.
        """
        old, pairs = len(self.pairs), []
        stay = choose_images(torch.cat(facts))
        for row in stay:
            if row < old:
                pairs.append(self.pairs[row])
            else:
                pair = torch.stack([predicted[row - old], true[row - old]])
                pairs.append(
                    (bytes_from_linear(pair.float()) if self._channel == "color" else pair).unsqueeze(0)
                )
        self.pairs, self.facts = pairs, [facts[row] for row in stay]

    @property
    def _channel(self) -> str:
        (channel,) = self.reads
        return channel

    def compute(self) -> dict[str, Tensor]:
        numbers = dim_zero_cat(self.numbers) if len(self.numbers) else torch.zeros(0, len(self.keys)).double()
        results: dict[str, Tensor] = {}
        for key, column in zip(self.keys, numbers.T, strict=True):
            known = column[~column.isnan()]
            error = known.std() / math.sqrt(len(known)) if len(known) > 1 else known.new_tensor(math.nan)
            results |= {key: known.mean(), f"{key}_sem": error}
        return results

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.images.picture import sheet

        key, heading = self.keys[0], self.columns[self.keys[0]]
        score = dim_zero_cat(self.numbers)[:, 0].cpu() if len(self.numbers) else torch.zeros(0)
        score = score[~score.isnan()]
        shown, summary = {}, f"no image has a {heading}"
        if len(score):
            mean, error = (float(self.compute()[name]) for name in (key, f"{key}_sem"))
            summary = f"{heading}: {mean:.3g} ± {error:.2g}, mean and standard error of {len(score)} images"
            facts, pairs = (
                dim_zero_cat(self.facts).cpu(),
                [pair for part in self.pairs for pair in part.cpu()],
            )
            order = sorted(range(len(facts)), key=lambda row: facts[row].tolist())
            middle = min(order, key=lambda row: abs(float(facts[row, 0] - score.median())))
            ends = order if self.better[key] == "higher" else order[::-1]
            for name, row in {"worst": ends[0], "near the median": middle, "best": ends[-1]}.items():
                value, index = facts[row].tolist()
                shown[f"{name}: image {index:.0f}\n{heading}: {value:.3g}"] = pairs[row].numpy()
        return sheet(self._channel, shown, title, summary, synthetic=synthetic)


def check_images(channel: str, predicted: Tensor, true: Tensor, by: str) -> None:
    """Check that predicted and true images can be compared.

    Args:
        channel: channel of the images, "color", "mask" or "depth".
        predicted: the predicted images of a batch.
        true: the true images.
        by: name of the metric, for messages.

    Raises:
        DataError: shapes or number types do not fit, or the images contain NaN or infinite numbers (+inf is allowed for
            depths).
    """
    dimensions = 4 if channel == "color" else 3
    shape = "(batch, height, width, channel)" if channel == "color" else "(batch, height, width)"
    typed = all((image.dtype == torch.bool) == (channel == "mask") for image in (predicted, true))
    typed &= channel == "mask" or (predicted.is_floating_point() and true.is_floating_point())
    if predicted.shape != true.shape or predicted.dim() != dimensions or not typed:
        raise DataError(
            f"metric {by} got predicted {channel!r} of {describe_tensor(predicted)} and true {channel!r} of "
            f"{describe_tensor(true)}, expected the same shape {shape} for both, "
            f"{'of type bool' if channel == 'mask' else 'of floating-point numbers (linear RGB, not 8-bit)'}."
        )
    for whose, image in {"predicted": predicted, "true": true}.items():
        # the background of a depth image is +inf; linear RGB may be any finite number
        wrong = ~(image > -math.inf) | ((image == math.inf) & (channel != "depth"))
        if wrong.any():
            first = int(wrong.flatten(1).any(1).nonzero()[0])
            raise DataError(
                f"metric {by} got {int(wrong.sum())} numbers of {whose} {channel!r} that are NaN or infinite, the "
                "first in "
                f"row {first} of the batch. Only finite numbers{' or +inf' if channel == 'depth' else ''} are allowed, "
                "because a mean over the other numbers would hide the fault."
            )


def describe_tensor(image: Tensor) -> str:
    """Return number type and shape of an image as text for a message."""
    return f"{str(image.dtype).removeprefix('torch.')} {tuple(image.shape)}"
