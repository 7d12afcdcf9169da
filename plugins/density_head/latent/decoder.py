"""The decoder of latent-variable density heads, from features and a latent vector to a component's raw parameters."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

LARGEST_FEATURE = 1e6
"""Bound to which features are clamped, so that no raw parameter overflows in the layers that follow."""


class LatentDecoder(nn.Module):
    """Two hidden layers of (features, z), plus a path linear in the features and one linear in z.

    The decoder reads `size` raw parameters of an item: `hidden` features of the network, then `numbers` that are added
    to its output for every z, then `numbers × latent` that modify the path linear in z. So the framework's linear layer
    is the first layer of all three and is computed once per item; a layer of z alone is added to the features, once per
    sample.

    The two linear paths prevent a mixture over several numbers from collapsing. The shared numbers shift all components
    together, so that what each component must learn (an angle that the image determines) does not favour the component
    that learnt it first. `spread` makes components differ from the first step. The image modifies it: two opposite
    directions, whose mean carries no information, differ in the second moment, and this path learns from it at first
    order.

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
        """Return the component's raw parameters, (*batch, numbers), for each z."""
        raw = raw.to(z.dtype).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        features, shared, turned = raw.split(self.parts, -1)
        spread = self.spread + turned.unflatten(-1, self.spread.shape)
        mixed = self.body(features + self.from_latent(z))
        return mixed + shared + torch.einsum("...nl,...l->...n", spread, z)
