"""The decoder of latent-variable density heads: features and a latent vector give a component's raw parameters."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

LARGEST_FEATURE = 1e6
"""Bound to which features are clamped, so that no raw parameter overflows in the layers that follow."""


class LatentDecoder(nn.Module):
    """Network of two hidden layers that reads features and a latent vector z, with two additional linear paths.

    One path adds a linear function of the features to the output, and the other a linear function of z.

    The decoder reads `size` raw parameters of an item: `hidden` features, then `numbers` values that are added to the
    output for every z, then `numbers × latent` values that modify the path linear in z. So the framework's linear layer
    is the first layer of all three parts and is computed once per item. A layer of z alone is computed once per sample
    and added to the features.

    The two linear paths prevent a mixture over several numbers from collapsing. The path linear in the features shifts
    all components together. So what every component must learn (an angle that the image determines) does not favour the
    component that learned it first. The matrix `spread` of the path linear in z makes components differ from the first
    step, and the features modify it. If a target has either of two opposite directions, its mean holds no information
    about them, but its second moment does; this path can learn from the second moment at first order.

    Args:
        latent: dimensions of z.
        hidden: width of both layers.
        numbers: number of raw parameters that the component reads.
    """

    def __init__(self, latent: int, hidden: int, numbers: int) -> None:
        super().__init__()
        self.parts = [hidden, numbers, numbers * latent]
        self.size = sum(self.parts)
        self.from_latent = nn.Linear(latent, hidden, bias=False)
        self.body = nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, numbers))
        # each number starts as N(0, 1) over z
        self.spread = nn.Parameter(torch.randn(numbers, latent) * latent**-0.5)

    def forward(
        self, raw: Float[Tensor, "*#batch size"], z: Float[Tensor, "*#batch latent"]
    ) -> Float[Tensor, "*batch numbers"]:
        """Return the component's raw parameters for each z, (*batch, numbers)."""
        raw = raw.to(z.dtype).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        features, shared, turned = raw.split(self.parts, -1)
        spread = self.spread + turned.unflatten(-1, self.spread.shape)
        mixed = self.body(features + self.from_latent(z))
        if torch.compiler.is_exporting():  # ONNX does not broadcast in such a sum
            return mixed + shared + (spread * z.unsqueeze(-2)).sum(-1)
        return mixed + shared + torch.einsum("...nl,...l->...n", spread, z)
