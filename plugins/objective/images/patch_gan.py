"""Adversarial training of predicted images with discriminators of patches."""

from typing import Annotated, Literal

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor
from torch.func import functional_call

from framework.data import Batch
from framework.model import Predictor, independent_penalty
from framework.objective import AdversaryOptimizer, Objective
from plugins.objective.images.discriminator import build_discriminators
from plugins.objective.images.predicted import predicted_images


class PatchGAN(Objective):
    """Adversarial penalty on images: discriminators are trained to distinguish predicted images from true ones.

    The predictor is trained to give images that the discriminators take for true ones. The penalty is κ L_GAN + γ L_FM
    of thesis eq. 7.6, on patches, at several scales as in Wang et al. 2018, §3.2-3.3. Losses are least squares (Mao et
    al. 2017, eq. 9): for a predicted image x and a true image y, the discriminators minimise ½ E (D(y) - 1)² + ½ E
    D(x)², and the predictor minimises E (D(x) - 1)². L_FM is the mean L1 distance between the discriminators' features
    of x and of y. The discriminators have an `AdversaryOptimizer`; their loss is logged as "discriminator".

    Args:
        weight: κ; the discriminators' own loss is multiplied by κ too, which does not affect their optimiser.
        feature_matching: γ / κ.
        scales: number of discriminators, each at half the resolution of the previous one.
        width: channels of the first layer of a discriminator.
        layers: number of layers of stride 2 of a discriminator.
        learning_rate, schedule: learning rate of the discriminators' optimiser, and its change during training.
        seed: seed of the discriminators' initial weights.
    """

    bibtex = "wang2018high"

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
        self.discriminators = build_discriminators(scales, width, layers, seed)
        self.adversary_optimizer = AdversaryOptimizer(learning_rate=learning_rate, schedule=schedule)

    def forward(self, predictor: Predictor, batch: Batch) -> Float[Tensor, ""]:
        """Return the weighted penalty of a batch."""
        images, wanted = predicted_images(predictor, batch)
        lead = images.shape[:-3]
        false = images.reshape(-1, *images.shape[-3:]).movedim(-1, 1)
        true = wanted.flatten(0, -4).movedim(-1, 1)
        own = {name: parameter.to(images.dtype) for name, parameter in self.discriminators.named_parameters()}
        fixed = {name: parameter.detach() for name, parameter in own.items()}
        judged = functional_call(self.discriminators, own, (true,))
        fooled = functional_call(self.discriminators, fixed, (false,))
        caught = functional_call(self.discriminators, own, (false.detach(),))
        count = max(1, len(images))
        of_true = [(1 - outputs[-1]).square() / 2 for outputs in judged]
        of_false = [outputs[-1].square() / 2 for outputs in caught]
        discrimination = self._mean(of_true, (len(true),)).sum() / max(1, len(true))
        discrimination = discrimination + self._mean(of_false, lead).sum() / max(1, len(false))
        deception = (
            independent_penalty(self._mean([(1 - outputs[-1]).square() for outputs in fooled], lead)).sum()
            / count
        )
        matching = independent_penalty(self._matching(fooled, judged, lead, wanted.shape[:-3])).sum() / count
        self.logged_terms = {
            "generator": deception.detach(),
            "feature_matching": matching.detach(),
            "discriminator": discrimination.detach(),
        }
        # The discriminators' own loss contributes only its gradient, not its value.
        return self.weight * (
            deception + self.feature_matching * matching + discrimination - discrimination.detach()
        )

    def _mean(self, judged: list[Tensor], lead: tuple[int, ...]) -> Float[Tensor, "*lead"]:
        """Return for each image the mean over its patches, and over the scales, of the numbers in `judged`.

        `judged` has one tensor for each scale, (image, 1, height, width), and `lead` is the shape of the result.
        """
        return torch.stack([outputs.mean((-3, -2, -1)) for outputs in judged]).mean(0).reshape(lead)

    def _matching(
        self,
        false: list[list[Tensor]],
        true: list[list[Tensor]],
        lead: tuple[int, ...],
        of_true: tuple[int, ...],
    ) -> Float[Tensor, "*lead"]:
        """Return the mean L1 distance between the discriminators' features of predicted and of true images.

        The mean is over all scales and all layers except the last (Wang et al. 2018, eq. 4).

        Args:
            false: outputs of the layers for predicted images, for each scale.
            true: outputs of the layers for true images, for each scale.
            lead: batch shape of the predicted images, (batch,) or (batch, member).
            of_true: batch shape of the true images, which broadcasts to `lead`.
        """
        distances = []
        for false_outputs, true_outputs in zip(false, true, strict=True):
            for ours, theirs in zip(false_outputs[:-1], true_outputs[:-1], strict=True):
                ours = ours.unflatten(0, lead)
                theirs = theirs.detach().unflatten(0, of_true)
                distances.append((ours - theirs).abs().mean((-3, -2, -1)))
        return torch.stack(distances).mean(0)
