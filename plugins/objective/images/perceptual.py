"""Distances of predicted and true images in the features of a network."""

from abc import abstractmethod
from hashlib import sha256
from typing import Annotated

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor

from framework.configuration.paths import FilePath
from framework.data import Batch
from framework.errors import ConfigError
from framework.model import Predictor, independent_penalty
from framework.objective import Objective
from plugins.objective.images.predicted import predicted_images
from plugins.objective.images.vgg import TAPS, VGG, Depth, drawn, trained

Weight = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Cache = Annotated[int, Field(ge=0, le=2**20)]


class FeatureDistance(Objective):
    """The mean L1 distance of features at several depths, with the largest weight on the deepest.

    It is Σ_l 2^(l - L) ‖φ_l(x) - φ_l(y)‖₁/n_l over the taps l = 1 … L (Wang et al. 2018, §3.4).

    The features of true images are kept in memory as long as they fit. They are looked up by the content of the image,
    so that data which vary between epochs are handled correctly.
    """

    def __init__(self, weight: float, network: VGG, cache: int) -> None:
        super().__init__()
        self.weight = weight
        self.network = network
        self.most = cache * 2**20
        self.kept: dict[bytes, list[Tensor]] = {}
        self.bytes = 0

    @property
    @abstractmethod
    def term(self) -> str:
        """Name of the distance in the journal."""

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        images, true = predicted_images(predictor, batch)
        lead = images.shape[:-3]
        found = self.network(images.reshape(-1, *images.shape[-3:]).movedim(-1, 1))
        wanted = self._features(true.flatten(0, -4))
        distance = images.new_zeros(lead)
        for level, (one, other) in enumerate(zip(found, wanted, strict=True), 1 - len(found)):
            ours = one.unflatten(0, lead)
            theirs = other.unflatten(0, true.shape[:-3])
            distance = distance + 2.0**level * (ours - theirs).abs().mean((-3, -2, -1))
        mean = independent_penalty(distance).sum() / max(1, len(images))
        self.logged_terms = {self.term: mean.detach()}
        return self.weight * mean

    @torch.no_grad()
    def _features(self, true: Float[Tensor, "batch height width number"]) -> list[Tensor]:
        if not self.most:
            return self.network(true.movedim(-1, 1))
        keys = [sha256(image.cpu().numpy().tobytes()).digest() for image in true]
        new = [row for row, key in enumerate(keys) if key not in self.kept]
        rows = {}
        if new:
            found = self.network(true[new].movedim(-1, 1))
            rows = {keys[row]: [level[place] for level in found] for place, row in enumerate(new)}
        every = [rows[key] if key in rows else self.kept[key] for key in keys]
        for key, features in rows.items():
            self._keep(key, features)
        return (
            [torch.stack(level) for level in zip(*every, strict=True)]
            if every
            else self.network(true.movedim(-1, 1))
        )

    def _keep(self, key: bytes, features: list[Tensor]) -> None:
        size = sum(level.nbytes for level in features)
        # A full cache replaces nothing: each image comes once an epoch, and the oldest entry is the next one needed.
        if self.bytes + size <= self.most:
            self.kept[key] = features
            self.bytes += size


class Perceptual(FeatureDistance):
    """Distance of features of a VGG network trained on ImageNet, L_VGG of thesis eq. 7.6 (Johnson et al. 2016).

    Args:
        weight: α.
        weights: torchvision's file of the network. Nothing replaces it: without a file choose
            objective=random_features, whose name says what it is.
        layers: 16, with features of four depths, or 19, of five.
        cache: MiB of true images' features that are kept.

    Raises:
        ConfigError: no file, or one of another network.
        CheckpointError: the file is damaged.
    """

    bibtex = """@inproceedings{johnson2016perceptual,
  author    = {Johnson, Justin and Alahi, Alexandre and Fei-Fei, Li},
  title     = {Perceptual Losses for Real-Time Style Transfer and Super-Resolution},
  booktitle = {European Conference on Computer Vision (ECCV)},
  year      = {2016}
}"""

    def __init__(
        self,
        *,
        weight: Weight = 1.0,
        weights: FilePath | None = None,
        layers: Depth = 16,
        cache: Cache = 1024,
    ) -> None:
        if weights is None:
            raise ConfigError(
                f"objective.perceptual.weights is null; wanted torchvision's file of VGG{layers}, which is not "
                "shipped. Name it, or choose objective=random_features, whose network is not trained."
            )
        super().__init__(weight, trained(layers, weights), cache)

    @property
    def term(self) -> str:
        """Name of the distance in the journal."""
        return "perceptual"


class RandomFeatures(FeatureDistance):
    """Distance of features of a convolutional network with random weights: edges and textures of many scales.

    The network has learned nothing about images: the distance is no perceptual loss, and is never called one.

    Args:
        weight: factor.
        width: channels of the first block; VGG has 64.
        depth: number of blocks, each of half the resolution of the previous one.
        seed: seed of the weights.
        cache: as of `Perceptual`.
    """

    bibtex = """@inproceedings{ustyuzhaninov2017texture,
  author    = {Ustyuzhaninov, Ivan and Brendel, Wieland and Gatys, Leon and Bethge, Matthias},
  title     = {What Does it Take to Generate Natural Textures?},
  booktitle = {International Conference on Learning Representations (ICLR)},
  year      = {2017}
}"""

    def __init__(
        self,
        *,
        weight: Weight = 1.0,
        width: Annotated[int, Field(ge=4, le=64, multiple_of=4)] = 16,
        depth: Annotated[int, Field(ge=1, le=4)] = 3,
        seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        cache: Cache = 1024,
    ) -> None:
        super().__init__(weight, drawn(16, width, TAPS[16][:depth], seed), cache)

    @property
    def term(self) -> str:
        """Name of the distance in the journal."""
        return "random_features"
