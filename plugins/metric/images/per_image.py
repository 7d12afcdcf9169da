"""Base class of metrics over single images: numbers of each image, their means, and a figure of some images."""

import math
from abc import abstractmethod
from typing import TYPE_CHECKING

import torch
from jaxtyping import Float
from torch import Tensor
from torchmetrics.utilities import dim_zero_cat

from framework.errors import DataError
from framework.geometry.srgb import bytes_from_linear
from framework.metric import HasFigure, Metric
from framework.prediction import Prediction

if TYPE_CHECKING:
    from matplotlib.figure import Figure

KEPT = 8
"""Number of random images that are kept beside the worst and the best; the one closest to the median is shown."""


class PerImage(Metric, HasFigure):
    """Base class of metrics that judge images one by one, in the one channel that `reads` names.

    `judge` returns the numbers of one image; images are ranked by the first number. A number is NaN where an image has
    none; mean and standard error are over the other images. The numbers of all images are held until the end, and at
    most KEPT + 2 images. Images are judged one by one, so that the batch size changes neither a bit of the result nor
    the memory that is needed.

    Raises:
        DataError: a batch has no true image, or images do not fit or hold NaN.
    """

    keys: tuple[str, ...]
    masked: bool
    """Flag that `judge` is given the true masks."""
    numbers: list[Tensor]
    pairs: list[Tensor]
    facts: list[Tensor]

    def start(self, *keys: str, masked: bool = False) -> None:
        """Declare the metric's states; the constructor of a subclass calls this method.

        Args:
            keys: names of the numbers that `judge` returns, in its order.
            masked: whether `judge` is given the true masks.
        """
        self.keys, self.masked = keys, masked
        self.columns = {key: heading for key, heading in self.columns.items() if key in keys}  # type: ignore[misc]
        self.better = {key: way for key, way in self.better.items() if key in keys}  # type: ignore[misc]
        # shapes: numbers (image, key); each kept pair (1, predicted or true, height, width[, number]); its facts (1, 2)
        for name in ("numbers", "pairs", "facts"):
            self.add_state(name, [], dist_reduce_fx="cat")

    @abstractmethod
    def judge(self, predicted: Tensor, true: Tensor, mask: Tensor | None) -> list[Float[Tensor, ""]]:
        """Return the numbers of one image, in the order of the keys.

        Args:
            predicted: the predicted image, (height, width[, number]).
            true: the true image, of the same shape.
            mask: the true mask, (height, width); None unless `masked`.
        """

    def update(self, prediction: Prediction) -> None:
        channel, name = self._channel, type(self).__name__
        predicted, true = prediction.image(channel), prediction.true_image(channel)
        require(channel, predicted, true, name)
        masks: list[Tensor | None] = [None] * len(true)
        if self.masked:
            if "mask" not in prediction.batch:
                raise DataError(
                    f"{name} looks inside the true mask too, but batches have only {', '.join(prediction.batch)}. Set "
                    "its `masked` to false, or choose data that give a mask."
                )
            mask = prediction.true_image("mask")
            if mask.dtype != torch.bool or mask.shape != true.shape[:3]:
                raise DataError(f"the true masks are {told(mask)}; wanted bool {tuple(true.shape[:3])}.")
            masks = list(mask)
        if len(true) == 0:
            return
        each = [torch.stack(self.judge(*one)) for one in zip(predicted, true, masks, strict=True)]
        numbers = torch.stack(each).double()
        self.numbers.append(numbers)
        facts = torch.stack([numbers[:, 0], prediction.batch["index"].double()], -1)
        self._keep([*self.facts, *facts.split(1)], predicted, true)

    def _keep(self, facts: list[Tensor], predicted: Tensor, true: Tensor) -> None:
        """Choose the images to hold, among those held before and those of a batch, whose facts come last in `facts`."""
        old, pairs = len(self.pairs), []
        stay = kept(torch.cat(facts))
        for place in stay:
            if place < old:
                pairs.append(self.pairs[place])
            else:
                pair = torch.stack([predicted[place - old], true[place - old]])
                pairs.append(
                    (bytes_from_linear(pair.float()) if self._channel == "color" else pair).unsqueeze(0)
                )
        self.pairs, self.facts = pairs, [facts[place] for place in stay]

    @property
    def _channel(self) -> str:
        (channel,) = self.reads
        return channel

    def compute(self) -> dict[str, Tensor]:
        seen = dim_zero_cat(self.numbers) if len(self.numbers) else torch.zeros(0, len(self.keys)).double()
        found: dict[str, Tensor] = {}
        for key, column in zip(self.keys, seen.T, strict=True):
            known = column[~column.isnan()]
            error = known.std() / math.sqrt(len(known)) if len(known) > 1 else known.new_tensor(math.nan)
            found |= {key: known.mean(), f"{key}_sem": error}
        return found

    def figure(self, title: str, *, synthetic: bool) -> "Figure":
        from plugins.metric.images.picture import sheet

        key, heading = self.keys[0], self.columns[self.keys[0]]
        score = dim_zero_cat(self.numbers)[:, 0].cpu() if len(self.numbers) else torch.zeros(0)
        score = score[~score.isnan()]
        shown, summary = {}, f"no image has a {heading}"
        if len(score):
            mean, error = (float(self.compute()[name]) for name in (key, f"{key}_sem"))
            summary = f"{heading}: {mean:.3g} ± {error:.2g}, mean and standard error of {len(score)} images"
            facts, pairs = dim_zero_cat(self.facts).cpu(), [one for part in self.pairs for one in part.cpu()]
            order = sorted(range(len(facts)), key=lambda place: facts[place].tolist())
            middle = min(order, key=lambda place: abs(float(facts[place, 0] - score.median())))
            ends = order if self.better[key] == "higher" else order[::-1]
            for name, place in {"worst": ends[0], "near the median": middle, "best": ends[-1]}.items():
                value, index = facts[place].tolist()
                shown[f"{name}: image {index:.0f}\n{heading}: {value:.3g}"] = pairs[place].numpy()
        return sheet(self._channel, shown, title, summary, synthetic=synthetic)


def kept(facts: Float[Tensor, "image 2"]) -> list[int]:
    """Return the places of the images that may have to be shown, in ascending order.

    They are the image with the lowest score, that with the highest, and KEPT images at random; the choice does not
    depend on the order of the images. Images without a score (NaN) are left out.

    Args:
        facts: score and index of each image.
    """
    told = facts.tolist()
    known = sorted((place for place, (score, _) in enumerate(told) if score == score), key=told.__getitem__)
    # Knuth's multiplicative hash
    random = sorted(known, key=lambda place: int(told[place][1]) * 2654435761 % 2**32)
    return sorted({*known[:1], *known[-1:], *random[:KEPT]})


def require(channel: str, predicted: Tensor, true: Tensor, by: str) -> None:
    """Refuse images that cannot be compared.

    Raises:
        DataError: shapes or number types do not fit, or the images hold NaN or infinite numbers (+inf is allowed in
            depths).
    """
    dimensions = 4 if channel == "color" else 3
    wanted = "(batch, height, width, number)" if channel == "color" else "(batch, height, width)"
    typed = all((one.dtype == torch.bool) == (channel == "mask") for one in (predicted, true))
    typed &= channel == "mask" or (predicted.is_floating_point() and true.is_floating_point())
    if predicted.shape != true.shape or predicted.dim() != dimensions or not typed:
        raise DataError(
            f"{by} got predicted {channel!r} {told(predicted)} and true ones {told(true)}; wanted two of one shape "
            f"{wanted}, {'bool' if channel == 'mask' else 'of real numbers (light, not 8-bit)'}."
        )
    for whose, image in {"predicted": predicted, "true": true}.items():
        # the background of a depth image is +inf; linear RGB may be any finite number
        wrong = ~(image > -math.inf) | ((image == math.inf) & (channel != "depth"))
        if wrong.any():
            first = int(wrong.flatten(1).any(1).nonzero()[0])
            raise DataError(
                f"{by} got {int(wrong.sum())} numbers of {whose} {channel!r} that are NaN or infinite, the first in "
                f"row {first} of the batch; wanted finite ones{' or +inf' if channel == 'depth' else ''}. A mean "
                "over the others would hide it."
            )


def told(image: Tensor) -> str:
    """Return number type and shape of an image, for a message."""
    return f"{str(image.dtype).removeprefix('torch.')} {tuple(image.shape)}"
