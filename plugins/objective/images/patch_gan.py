"""Adversarial training of predicted images."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.func import functional_call

from framework.data import Batch
from framework.model import Predictor, independent_penalty
from framework.objective import AdversaryOptimizer, Objective
from plugins.objective.images.discriminator import drawn
from plugins.objective.images.predicted import predicted_images


class PatchGAN(Objective):
    """Discriminators learn to tell predicted images from true ones, and the predictor learns to deceive them.

    The penalty is κ L_GAN + γ L_FM of thesis eq. 7.6, on patches, at several scales as in Wang et al. 2018, §3.2-3.3.
    Judgements are compared by least squares (Mao et al. 2017, eq. 9): the discriminators minimise ½ E (D(y) - 1)² + ½ E
    D(x)², the predictor E (D(x) - 1)², and L_FM is the mean L1 distance of the discriminators' features of x and y. The
    discriminators have an `AdversaryOptimizer`; their loss is logged as "discriminator".

    Args:
        weight: κ; the discriminators' own loss is multiplied by it too, which does not affect their optimiser.
        feature_matching: γ, relative to the same weight.
        scales, width, layers: of the discriminators.
        learning_rate, schedule: of their optimiser.
        seed: seed of their initial weights.
    """

    bibtex = """@inproceedings{wang2018high,
  author    = {Wang, Ting-Chun and Liu, Ming-Yu and Zhu, Jun-Yan and Tao, Andrew and Kautz, Jan and Catanzaro, Bryan},
  title     = {High-Resolution Image Synthesis and Semantic Manipulation with Conditional {GANs}},
  booktitle = {IEEE Conference on Computer Vision and Pattern Recognition (CVPR)},
  year      = {2018}
}"""

    def __init__(
        self,
        *,
        weight: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1.0,
        feature_matching: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 0.1,
        scales: Annotated[int, Field(ge=1, le=4)] = 2,
        width: Annotated[int, Field(ge=4, le=128)] = 32,
        layers: Annotated[int, Field(ge=1, le=5)] = 3,
        learning_rate: Annotated[float, Field(gt=0, allow_inf_nan=False)] = 1e-4,
        schedule: Literal["constant", "cosine"] = "constant",
        seed: Annotated[int, Field(ge=0, lt=2**31)] = 0,
    ) -> None:
        super().__init__()
        self.weight = weight
        self.feature_matching = feature_matching
        self.discriminators = drawn(scales, width, layers, seed)
        self.adversary_optimizer = AdversaryOptimizer(learning_rate=learning_rate, schedule=schedule)

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        images, wanted = predicted_images(predictor, batch)
        lead = images.shape[:-3]
        false = images.reshape(-1, *images.shape[-3:]).movedim(-1, 1)
        true = wanted.flatten(0, -4).movedim(-1, 1)
        own = {name: one.to(images.dtype) for name, one in self.discriminators.named_parameters()}
        fixed = {name: one.detach() for name, one in own.items()}
        judged = functional_call(self.discriminators, own, (true,))
        fooled = functional_call(self.discriminators, fixed, (false,))
        caught = functional_call(self.discriminators, own, (false.detach(),))
        count = max(1, len(images))
        of_true = [(1 - one[-1]).square() / 2 for one in judged]
        of_false = [one[-1].square() / 2 for one in caught]
        against = self._mean(of_true, (len(true),)).sum() / max(1, len(true))
        against = against + self._mean(of_false, lead).sum() / max(1, len(false))
        taken = (
            independent_penalty(self._mean([(1 - one[-1]).square() for one in fooled], lead)).sum() / count
        )
        alike = independent_penalty(self._matching(fooled, judged, lead, wanted.shape[:-3])).sum() / count
        self.logged_terms = {
            "generator": taken.detach(),
            "feature_matching": alike.detach(),
            "discriminator": against.detach(),
        }
        # The discriminators' own loss contributes only its gradient: the predictor does not minimise it.
        return self.weight * (taken + self.feature_matching * alike + against - against.detach())

    def _mean(self, judged: list[Tensor], lead: tuple[int, ...]) -> Float[Tensor, "*lead"]:
        """Return the mean over patches, then over scales."""
        return torch.stack([one.mean((-3, -2, -1)) for one in judged]).mean(0).reshape(lead)

    def _matching(
        self,
        false: list[list[Tensor]],
        true: list[list[Tensor]],
        lead: tuple[int, ...],
        of_true: tuple[int, ...],
    ) -> Float[Tensor, "*lead"]:
        """Return the mean feature distance over all scales and all layers but the last (Wang et al. 2018, eq. 4)."""
        found = []
        for one, other in zip(false, true, strict=True):
            for ours, theirs in zip(one[:-1], other[:-1], strict=True):
                ours = ours.unflatten(0, lead)
                theirs = theirs.detach().unflatten(0, of_true)
                found.append((ours - theirs).abs().mean((-3, -2, -1)))
        return torch.stack(found).mean(0)
