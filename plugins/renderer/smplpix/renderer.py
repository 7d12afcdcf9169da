"""Renderer that computes the image of a scene's coloured vertices with a trained network."""

from collections.abc import Collection
from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.configuration.loading import read_stored, rebuild
from framework.configuration.paths import FilePath, flatten
from framework.distributions.protocol import images
from framework.errors import CheckpointError, ConfigError, DataError
from framework.geometry.mesh_files import COLOURS, XYZ
from framework.geometry.srgb import srgb_from_linear
from framework.model import Predictor
from framework.renderer import Scene, TrainedRenderer

COLUMNS = (*XYZ, *COLOURS)
"""First columns of the points on which the network must have been trained."""
SIZES_KEPT = 4
"""Number of image sizes whose networks are kept in memory."""
LARGEST_CHANGE, MEAN_CHANGE = 4 / 255, 0.05 / 255
"""Largest and mean difference between sRGB colours by bfloat16 and by float32 that `precision="auto"` accepts."""


class SMPLpix(TrainedRenderer):
    """Renderer that draws a scene with the trained network of a run of `smplpix/quick` or a similar experiment.

    Any pinhole camera is possible: vertices are transformed to the canonical camera of the image size, in which they
    have the same pixels (`Camera.to_canonical`). Faces are used only by a run whose encoder rasterises a mesh; such a
    run draws the faces of its own topology. A run that projects points can also draw a set of points without faces; it
    leaves out vertices that are not finite or are nearer than the near plane.

    The background is white; a trained network predicts values so close to 1 that the difference hardly shows in 8 bits.
    The network can draw images of any size. The quality is best at the image size of training, at which the points have
    the density that the network has seen.

    Args:
        checkpoint: folder of a run, its model.ckpt, or an MLflow run id.
        paths: files and folders that the run's configuration names. A path that is stored in the checkpoint is used
            only if it is repeated here, as in `renderer.paths={encoder: {rasterised: {body: ...}}}`.
        precision: number type of evaluation. "auto" is bfloat16 under two conditions, and float32 otherwise: the
            processor computes bfloat16 faster than float32; and the colours of a test image by bfloat16 and by float32
            differ by at most `LARGEST_CHANGE`, and by at most `MEAN_CHANGE` on average. "trained" is the run's
            setting, which gives the same bits as the run's own predictions.
        crop: margin in pixels; the image is computed only in the subject's bounding box plus this margin. "whole"
            computes the whole image; "trained" uses the run's setting.

    Raises:
        ConfigError: there is no checkpoint, or its model does not predict an image from coloured points.
        CheckpointError: the checkpoint is damaged, or does not exist.
    """

    channels = frozenset({"color"})
    background = 1.0
    bibtex = "prokudin2021smplpix"

    def __init__(
        self,
        *,
        checkpoint: FilePath | None = None,
        paths: dict[str, Any] | None = None,
        precision: Literal["trained", "auto", "float32", "bfloat16"] = "auto",
        crop: Annotated[int, Field(ge=0)] | Literal["trained", "whole"] = "trained",
    ) -> None:
        if checkpoint is None:
            raise ConfigError(
                "renderer smplpix needs a trained network, but renderer.checkpoint is null. Train a network (`python "
                "-m framework experiment=smplpix/quick`) and set renderer.checkpoint to the printed run folder."
            )
        self.description, self._weights = read_stored(checkpoint, paths=flatten(paths or {}))
        target, columns = self.description.target, self.description.columns
        if target.kind != "image" or len(target.names) != 3 or columns[: len(COLUMNS)] != COLUMNS:
            raise ConfigError(
                f"{checkpoint} predicts {target.listed_names} from {', '.join(columns) or 'unnamed numbers'}; "
                "renderer smplpix requires a model that predicts red, green and blue from coloured points, as in "
                "smplpix/quick."
            )
        self.size = target.size
        for part in self.description.config["encoder"]:
            if crop != "trained" and "crop" in part:
                part["crop"] = None if crop == "whole" else crop
        self._predictors: dict[tuple[int, int], Predictor] = {}
        if precision == "auto" and any("precision" in part for part in self.description.config["encoder"]):
            exact, fast = self._test_image("float32"), self._test_image("auto")
            change = (fast - exact).abs()
            if not (change.max() <= LARGEST_CHANGE and change.mean() <= MEAN_CHANGE):
                precision = "float32"
        self._set_precision(precision)
        network = self._predictor(*self.size)
        self.parameters = sum(parameter.numel() for parameter in network.parameters())

    @torch.no_grad()
    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        _check_scene(scene, channels)
        if not channels:
            return {}
        camera = scene.camera
        predictor = self._predictor(camera.height, camera.width)
        try:
            image = images(predictor(colored_points(scene)[None]), ("color",))["color"][0]
        except DataError as error:
            raise ValueError(f"the network cannot draw this scene: {error}") from error
        return {"color": image.float().to(scene.vertices.device)}

    def _set_precision(self, precision: str) -> None:
        """Set the number type of evaluation of all encoders that have this setting; "trained" changes nothing."""
        for part in self.description.config["encoder"]:
            if precision != "trained" and part.get("precision", precision) != precision:
                part["precision"] = precision
                self._predictors.clear()

    @torch.no_grad()
    def _test_image(self, precision: str) -> Tensor:
        """Return the image of a small coloured sphere, sRGB, with evaluation in this precision."""
        self._set_precision(precision)
        encoders = self.description.config["encoder"]
        near, far = next(
            ((part["nearest"], part["farthest"]) for part in encoders if "nearest" in part), (1.0, 5.0)
        )
        count = int(self.description.input_shape[0])
        # a spiral of points at equal distances (Vogel 1979)
        height = torch.linspace(-1, 1, count)
        angle = torch.arange(count) * (torch.pi * (3 - 5**0.5))
        around = (1 - height.square()).sqrt()
        sphere = torch.stack([around * angle.cos(), height, around * angle.sin()], 1)
        position = torch.tensor([0.0, 0.0, (near + far) / 2]) + 0.05 * (near + far) * sphere
        points = torch.cat([position, 0.5 + 0.5 * sphere], 1)
        density = self._predictor(*self.size)(points[None])
        return srgb_from_linear(images(density, ("color",))["color"][0])

    def _predictor(self, height: int, width: int) -> Predictor:
        """Return the network for images of a size; all sizes share the same weights."""
        size = (height, width)
        if size not in self._predictors:
            encoders = [
                {**part, "height": height, "width": width} if {"height", "width"} <= part.keys() else part
                for part in self.description.config["encoder"]
            ]
            changed = replace(
                self.description,
                config={**self.description.config, "encoder": encoders},
                target=replace(self.description.target, size=size),
            )
            # building initialises random weights, which are then overwritten
            with torch.random.fork_rng(devices=[]):
                try:
                    predictor = rebuild(changed, self._weights)
                except CheckpointError as error:
                    if size == self.size:
                        raise
                    raise ValueError(
                        f"got an image size of {height} × {width}, but this network draws only {self.size[0]} × "
                        f"{self.size[1]}: {error}"
                    ) from error
            while len(self._predictors) >= SIZES_KEPT:
                del self._predictors[next(iter(self._predictors))]
            self._predictors[size] = predictor.requires_grad_(False)
        return self._predictors[size]


def colored_points(scene: Scene) -> Float[Tensor, "points 6"]:
    """Return the vertices as the network's input: positions in the canonical camera's axes, and sRGB colours.

    A vertex that must be invisible (not finite, or nearer than the near plane) is moved to the camera's centre. A scene
    without vertices gives one such vertex.
    """
    assert scene.colors is not None
    if not len(scene.vertices):
        return torch.zeros(1, len(COLUMNS))
    points = scene.camera.to_canonical(scene.vertices.detach().cpu()).float()
    rows = torch.cat([points, srgb_from_linear(scene.colors.detach().cpu().float())], 1)
    visible = rows.isfinite().all(1) & (rows[:, 2] >= float(scene.camera.near))
    return rows.where(visible[:, None], 0.0)


def _check_scene(scene: Scene, channels: Collection[str]) -> None:
    if unknown := set(channels) - SMPLpix.channels:
        raise ValueError(
            f"got the channels {', '.join(sorted(unknown))}, but SMPLpix draws only color. Request only color."
        )
    if not channels:
        return
    scene.camera.check_shapes()
    count = len(scene.vertices)
    if scene.vertices.shape != (count, 3) or scene.faces.dim() != 2 or scene.faces.shape[1] != 3:
        raise ValueError(
            f"got vertices of shape {tuple(scene.vertices.shape)} and faces of shape {tuple(scene.faces.shape)}, "
            "expected (vertices, 3) and (faces, 3)."
        )
    if len(scene.faces) and not 0 <= int(scene.faces.min()) <= int(scene.faces.max()) < count:
        raise ValueError(
            f"faces refer to vertices {int(scene.faces.min())} to {int(scene.faces.max())}, expected 0 to {count - 1}."
        )
    if scene.texture is not None:
        raise ValueError(
            "got a scene with a texture, but SMPLpix reads only colours of vertices. Remove the texture."
        )
    if scene.colors is None or scene.colors.shape != (count, 3):
        shape = "none" if scene.colors is None else str(tuple(scene.colors.shape))
        raise ValueError(
            f"got colours of shape {shape}, expected red, green and blue of each vertex, ({count}, 3)."
        )
