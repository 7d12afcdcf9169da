"""Evaluation of a renderer: its images of scenes on a background, their metrics, and the cost of a frame."""

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import cycle
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from framework.data import Batch
from framework.distributions.protocol import images
from framework.errors import ConfigError, DataError
from framework.evaluation.cost import Cost, measure
from framework.evaluation.splits import Evaluation, fresh, numbers
from framework.prediction import Prediction
from framework.renderer import Renderer, Scene

if TYPE_CHECKING:  # a metric imports torchmetrics, which a frame without a true image does not need
    from framework.metric import Metric

Ground = tuple[float, float, float]
"""Linear RGB behind the subject."""


@dataclass(frozen=True)
class Frame:
    """A scene to draw, and its true images.

    Attributes:
        name: name of the frame.
        scene: the scene, whose colours have a fourth channel that is 1 everywhere (`framework.renderer.HasScenes`).
        truth: fields of a batch of one: "index", "group" and the true images that are known.
    """

    name: str
    scene: Scene
    truth: Batch


class DrawnImages(Distribution):
    """Images that a renderer has drawn, in the form in which metrics read predicted images.

    Args:
        channels: images by channel, (batch, height, width[, number]).
    """

    def __init__(self, channels: Mapping[str, Tensor]) -> None:
        super().__init__(next(iter(channels.values())).shape[:1], validate_args=False)
        self.channels = channels


@images.register
def _(density: DrawnImages, channels: Collection[str]) -> dict[str, Tensor]:
    return {name: density.channels[name] for name in channels}


@dataclass(frozen=True)
class Painter:
    """A renderer, and the background of its images.

    Attributes:
        renderer: the renderer.
        ground: background of "color".
        channels: channels that are drawn.

    Raises:
        ConfigError: the renderer does not draw a channel, or cannot draw on the background.
    """

    renderer: Renderer
    ground: Ground
    channels: tuple[str, ...]

    def __post_init__(self) -> None:
        name = type(self.renderer).__name__
        if missing := sorted(set(self.channels) - self.renderer.channels):
            raise ConfigError(
                f"{name} does not draw the channels {', '.join(missing)}, but mode.channels or a metric asks for them. "
                f"It draws {', '.join(sorted(self.renderer.channels))}. Leave them out, or choose another renderer."
            )
        if "color" in self.channels and self.renderer.background and not self._on_own_ground:
            raise ConfigError(
                f"{name} draws on a background of {self.renderer.background:g}, linear RGB, and cannot draw on "
                f"{', '.join(f'{value:.3g}' for value in self.ground)}. Leave mode.background out."
            )

    @property
    def _on_own_ground(self) -> bool:
        return all(value == self.renderer.background for value in self.ground)

    def paint(self, frames: Sequence[Frame]) -> list[dict[str, Tensor]]:
        """Draw frames, and return the channels of each by name; "color" is linear RGB with three channels.

        Raises:
            DataError: the renderer cannot draw a scene; the message names the first frame.
        """
        rendered = self.draw([frame.scene for frame in frames], frames[0].name if frames else "")
        ground = torch.tensor(self.ground)
        return [
            channels
            if self._on_own_ground or "color" not in channels
            else {**channels, "color": _compose(channels["color"], ground)}
            for channels in rendered
        ]

    @torch.no_grad()
    def draw(self, scenes: Sequence[Scene], name: str) -> list[dict[str, Tensor]]:
        """Return the channels that the renderer draws for each scene.

        Args:
            scenes: scenes whose colours have four channels, as in `Frame`.
            name: name of the frame, for the error message.

        Raises:
            DataError: the renderer cannot draw a scene.
        """
        if self._on_own_ground:
            scenes = [without_cover(scene) for scene in scenes]
        try:
            return self.renderer.batch(scenes, self.channels)
        except ValueError as error:  # the message is a sentence about what the renderer cannot draw
            raise DataError(
                f"{type(self.renderer).__name__} cannot draw the frame {name}: {error}"
            ) from error


def _compose(color: Tensor, ground: Tensor) -> Tensor:
    """Return colours on a background; the fourth channel of `color` is the share of each pixel that is covered."""
    return color[..., :3] + (1 - color[..., 3:]) * ground.to(color)


def without_cover(scene: Scene) -> Scene:
    """Return a scene without the fourth channel of its colours."""
    texture = scene.texture
    if texture is not None:
        texture = replace(texture, images=tuple(image[..., :3] for image in texture.images))
    return replace(scene, colors=None if scene.colors is None else scene.colors[:, :3], texture=texture)


def evaluate_frames(
    painter: Painter,
    blocks: Iterable[Sequence[Frame]],
    metrics: "Sequence[Metric]",
    groups: Sequence[str],
    keep: Callable[[Frame, Mapping[str, Tensor]], None],
) -> Evaluation:
    """Draw all frames once, and return the value of every metric over all frames, in total and per group.

    Args:
        painter: renderer and background; its channels include those that the metrics read.
        blocks: all frames, in blocks; the frames of a block are drawn together.
        metrics: metrics to compute; they are copied.
        groups: names of the groups of frames; the field "group" of a frame's `truth` holds indices of these names.
        keep: function that is called with each frame and its channels, for example to write them to a file.
    """
    several = len(groups) > 1
    overall, by_group = _fresh(metrics), {name: _fresh(metrics) for name in groups if several}
    for frames in blocks:
        rendered = painter.paint(frames)
        for frame, channels in zip(frames, rendered, strict=True):
            keep(frame, channels)
            prediction = Prediction(
                DrawnImages({name: image[None] for name, image in channels.items()}), frame.truth, 1
            )
            readers = overall + (by_group[groups[int(frame.truth["group"])]] if several else [])
            for metric in readers:
                metric.update(prediction)
    return Evaluation(numbers(overall), {name: numbers(group) for name, group in by_group.items()}, overall)


def _fresh(metrics: "Sequence[Metric]") -> "list[Any]":
    return fresh(metrics, torch.device("cpu"))


def frame_cost(painter: Painter, frames: Sequence[Frame]) -> Cost:
    """Return the cost per frame of drawing `frames` together, and the run time of drawing one frame alone.

    A renderer may reuse results that have not changed since the last image. Therefore no two consecutive images are the
    same: the frames are drawn in turn, and a single frame alternates with a copy whose image is shifted by a pixel.

    Args:
        painter: renderer and channels.
        frames: at least one frame.
    """
    scenes = [frame.scene for frame in frames]
    count = len(scenes)
    if count == 1:
        camera = scenes[0].camera
        principal = (float(camera.principal[0]) + 1, float(camera.principal[1]))
        scenes.append(replace(scenes[0], camera=replace(camera, principal=principal)))
    order = cycle(range(len(scenes)))

    def draw(frame_numbers: Tensor) -> object:
        return painter.draw([scenes[next(order)] for _ in range(len(frame_numbers))], frames[0].name)

    learned = painter.renderer.parameters
    # without a network there is nothing of which torch counts operations
    measured = measure(draw, torch.arange(count), parameters=learned or None)
    return replace(measured, parameters=learned)
