"""Distances between the features of predicted and of true images, for a trained and for a random network."""

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
from plugins.objective.images.vgg import TAPS, VGG, Depth, random_vgg, read_vgg

Weight = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Cache = Annotated[int, Field(ge=0, le=2**20)]


class FeatureDistance(Objective):
    """The mean L1 distance between features at several depths, with the largest weight for the deepest features.

    Taps are the layers of a network whose outputs are compared. The distance of a predicted image x and a true image y
    is Σ_l 2^(l - L) ‖φ_l(x) - φ_l(y)‖₁/n_l over the taps l = 1 … L, where φ_l are the n_l features at tap l (Wang et
    al. 2018, §3.4).

    The features of true images are cached until the cache is full. The key is a hash of the image's content, so that
    the distance is correct even if the true image of a sample changes between epochs.

    Args:
        weight: factor of the distance.
        network: network whose features are compared.
        cache: MiB of features of true images that are kept in memory.
    """

    def __init__(self, weight: float, network: VGG, cache: int) -> None:
        super().__init__()
        self.weight = weight
        self.network = network
        self.cache_limit = cache * 2**20
        self.cached_features: dict[bytes, list[Tensor]] = {}
        self.cached_bytes = 0

    @property
    @abstractmethod
    def term(self) -> str:
        """Name of the distance in the journal."""

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        images, true = predicted_images(predictor, batch)
        lead = images.shape[:-3]
        predicted_features = self.network(images.reshape(-1, *images.shape[-3:]).movedim(-1, 1))
        true_features = self._features(true.flatten(0, -4))
        distance = images.new_zeros(lead)
        for level, (predicted, expected) in enumerate(
            zip(predicted_features, true_features, strict=True), 1 - len(predicted_features)
        ):
            ours = predicted.unflatten(0, lead)
            theirs = expected.unflatten(0, true.shape[:-3])
            distance = distance + 2.0**level * (ours - theirs).abs().mean((-3, -2, -1))
        mean = independent_penalty(distance).sum() / max(1, len(images))
        self.logged_terms = {self.term: mean.detach()}
        return self.weight * mean

    @torch.no_grad()
    def _features(self, true: Float[Tensor, "batch height width number"]) -> list[Tensor]:
        if not self.cache_limit:
            return self.network(true.movedim(-1, 1))
        keys = [sha256(image.cpu().numpy().tobytes()).digest() for image in true]
        new = [row for row, key in enumerate(keys) if key not in self.cached_features]
        rows = {}
        if new:
            new_features = self.network(true[new].movedim(-1, 1))
            rows = {keys[row]: [level[place] for level in new_features] for place, row in enumerate(new)}
        every = [rows[key] if key in rows else self.cached_features[key] for key in keys]
        for key, features in rows.items():
            self._cache(key, features)
        return (
            [torch.stack(level) for level in zip(*every, strict=True)]
            if every
            else self.network(true.movedim(-1, 1))
        )

    def _cache(self, key: bytes, features: list[Tensor]) -> None:
        size = sum(level.nbytes for level in features)
        # A full cache replaces nothing: each image comes once an epoch, and the oldest entry is the next one needed.
        if self.cached_bytes + size <= self.cache_limit:
            self.cached_features[key] = features
            self.cached_bytes += size


class Perceptual(FeatureDistance):
    """Distance between features of a VGG network trained on ImageNet, L_VGG of thesis eq. 7.6 (Johnson et al. 2016).

    Args:
        weight: factor α of L_VGG.
        weights: torchvision's file of the network's weights. Without this file choose objective=random_features, whose
            network is not trained.
        layers: 16, with features at four depths, or 19, with features at five.
        cache: MiB of features of true images that are kept in memory.

    Raises:
        ConfigError: no file is set, or the file belongs to another network.
        CheckpointError: the file is damaged.
    """

    bibtex = "johnson2016perceptual"

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
                f"objective.perceptual.weights is null, but torchvision's file of VGG{layers} is required, which this "
                "project does not contain. Set objective.perceptual.weights to this file, or choose "
                "objective=random_features, whose network is not trained."
            )
        super().__init__(weight, read_vgg(layers, weights), cache)

    @property
    def term(self) -> str:
        """Name of the distance in the journal."""
        return "perceptual"


class RandomFeatures(FeatureDistance):
    """Distance between features of a convolutional network with random weights, which respond to edges and textures.

    The network has learned nothing about images, so that the distance is not a perceptual loss and is not called one.

    Args:
        weight: factor.
        width: channels of the first block; VGG has 64.
        depth: number of blocks, each of half the resolution of the previous one.
        seed: seed of the weights.
        cache: MiB of features of true images that are kept in memory.
    """

    bibtex = "ustyuzhaninov2017texture"

    def __init__(
        self,
        *,
        weight: Weight = 1.0,
        width: Annotated[int, Field(ge=4, le=64, multiple_of=4)] = 16,
        depth: Annotated[int, Field(ge=1, le=4)] = 3,
        seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
        cache: Cache = 1024,
    ) -> None:
        super().__init__(weight, random_vgg(16, width, TAPS[16][:depth], seed), cache)

    @property
    def term(self) -> str:
        """Name of the distance in the journal."""
        return "random_features"
