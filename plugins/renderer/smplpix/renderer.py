"""Renderer with a trained network in place of a rasteriser: it reads a scene's vertices and paints the image."""

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
from framework.renderer import Renderer, Scene

COLUMNS = (*XYZ, *COLOURS)
"""Columns of the points that a run must have been trained on."""
SIZES_KEPT = 4
"""Number of image sizes whose networks are kept ready."""


class SMPLpix(Renderer):
    """Renderer that paints a scene with the trained network of a run of `smplpix/quick` or a similar experiment.

    The camera may be any camera: vertices are transformed to the canonical camera of its image size, which sees them at
    the same pixels (`Camera.to_canonical`). Faces matter only to a run that paints over a rasterised mesh, which then
    draws the faces of its own topology. A run of projected points also draws sets of points; it leaves out vertices
    that are not finite or nearer than the near plane.

    The background is white: in a trained network it is so near to 1 that 8 bits hardly show the difference. Networks
    read images of any size, but in training they have seen points as dense as those of the run's own size, and paint
    best there.

    Args:
        checkpoint: folder of a run, its model.ckpt, or an MLflow run id.
        paths: files and folders of that run's configuration, which are used only if they are given again here:
            `renderer.paths={encoder: {rasterised: {body: ...}}}`.
        precision: precision of evaluation, as in `encoder=unet`; "trained" for that of the run's configuration.
        crop: margin around the subject's box, pixels, within which the image is computed; "whole" for the whole image;
            "trained" for the run's setting.

    Raises:
        ConfigError: there is no checkpoint, or its model does not predict an image from coloured points.
        CheckpointError: the checkpoint is damaged, or does not exist.
    """

    channels = frozenset({"color"})
    background = 1.0
    bibtex = """@inproceedings{prokudin2021smplpix,
  title = {{SMPLpix}: Neural Avatars from {3D} Human Models},
  author = {Prokudin, Sergey and Black, Michael J. and Romero, Javier},
  booktitle = {IEEE/CVF Winter Conference on Applications of Computer Vision (WACV)},
  pages = {1810--1819},
  year = {2021}
}"""

    def __init__(
        self,
        *,
        checkpoint: FilePath | None = None,
        paths: dict[str, Any] | None = None,
        precision: Literal["trained", "auto", "float32", "bfloat16"] = "trained",
        crop: Annotated[int, Field(ge=0)] | Literal["trained", "whole"] = "trained",
    ) -> None:
        if checkpoint is None:
            raise ConfigError(
                "renderer smplpix draws with a trained network, but renderer.checkpoint is null. Train one (`python -m "
                "framework experiment=smplpix/quick`) and give the run folder it prints."
            )
        self.description, self._weights = read_stored(checkpoint, paths=flatten(paths or {}))
        target, columns = self.description.target, self.description.columns
        if target.kind != "image" or len(target.names) != 3 or columns[: len(COLUMNS)] != COLUMNS:
            raise ConfigError(
                f"{checkpoint} predicts {target.listed_names} from {', '.join(columns) or 'unnamed numbers'}; "
                "renderer smplpix wants a model that paints red, green and blue from coloured points, as those of smplpix/quick."
            )
        self.size = target.size
        for part in self.description.config["encoder"]:
            if precision != "trained" and "precision" in part:
                part["precision"] = precision
            if crop != "trained" and "crop" in part:
                part["crop"] = None if crop == "whole" else crop
        self._ready: dict[tuple[int, int], Predictor] = {}
        self._predictor(*self.size)

    @torch.no_grad()
    def __call__(self, scene: Scene, channels: Collection[str] = ("color",)) -> dict[str, Tensor]:
        _check(scene, channels)
        if not channels:
            return {}
        camera = scene.camera
        predictor = self._predictor(camera.height, camera.width)
        try:
            found = images(predictor(cloud(scene)[None]), ("color",))["color"][0]
        except DataError as error:
            raise ValueError(
                f"this scene is not of the kind that the network was trained on: {error}"
            ) from error
        return {"color": found.float().to(scene.vertices.device)}

    def _predictor(self, height: int, width: int) -> Predictor:
        """Return the network for images of a size; the weights are the same for all sizes."""
        size = (height, width)
        if size not in self._ready:
            encoders = [
                {**part, "height": height, "width": width} if {"height", "width"} <= part.keys() else part
                for part in self.description.config["encoder"]
            ]
            changed = replace(
                self.description,
                config={**self.description.config, "encoder": encoders},
                target=replace(self.description.target, size=size),
            )
            with torch.random.fork_rng(
                devices=[]
            ):  # building draws random weights, which are then overwritten
                try:
                    made = rebuild(changed, self._weights)
                except CheckpointError as error:
                    if size == self.size:
                        raise
                    raise ValueError(
                        f"a picture of {height} × {width} was asked for, but this network paints {self.size[0]} × "
                        f"{self.size[1]} alone: {error}"
                    ) from error
            while len(self._ready) >= SIZES_KEPT:
                del self._ready[next(iter(self._ready))]
            self._ready[size] = made.requires_grad_(False)
        return self._ready[size]


def cloud(scene: Scene) -> Float[Tensor, "points 6"]:
    """Return the vertices as data of coloured points give them: in the canonical camera's frame, with sRGB colours.

    A vertex that must not be seen (not finite, or before the near plane) is put into the camera itself; a scene without
    vertices has one such vertex.
    """
    assert scene.colors is not None
    if not len(scene.vertices):
        return torch.zeros(1, len(COLUMNS))
    points = scene.camera.to_canonical(scene.vertices.detach().cpu()).float()
    found = torch.cat([points, srgb_from_linear(scene.colors.detach().cpu().float())], 1)
    seen = found.isfinite().all(1) & (found[:, 2] >= float(scene.camera.near))
    return found.where(seen[:, None], 0.0)


def _check(scene: Scene, channels: Collection[str]) -> None:
    if unknown := set(channels) - SMPLpix.channels:
        raise ValueError(f"channels {', '.join(sorted(unknown))} were asked for; SMPLpix draws color alone.")
    if not channels:
        return
    scene.camera.check_shapes()
    count = len(scene.vertices)
    if scene.vertices.shape != (count, 3) or scene.faces.dim() != 2 or scene.faces.shape[1] != 3:
        raise ValueError(
            f"vertices of shape {tuple(scene.vertices.shape)} and faces of shape {tuple(scene.faces.shape)} came; "
            "wanted (vertices, 3) and (faces, 3)."
        )
    if len(scene.faces) and not 0 <= int(scene.faces.min()) <= int(scene.faces.max()) < count:
        raise ValueError(
            f"faces name vertices {int(scene.faces.min())} to {int(scene.faces.max())}; wanted 0 to {count - 1}."
        )
    if scene.texture is not None:
        raise ValueError("a scene with a texture came; SMPLpix reads colours of vertices. Leave it out.")
    if scene.colors is None or scene.colors.shape != (count, 3):
        came = "none" if scene.colors is None else str(tuple(scene.colors.shape))
        raise ValueError(
            f"colours of shape {came} came; wanted red, green and blue of each vertex, ({count}, 3)."
        )
