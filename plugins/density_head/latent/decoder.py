"""The decoder of latent-variable density heads: features and a latent vector in, a component's raw numbers out."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

LARGEST_FEATURE = 1e6
"""Features are cut off here, so that no raw number, however large, overflows in the layers behind."""


class LatentDecoder(nn.Module):
    """Two hidden layers of (features, z), plus a path linear in the features and one linear in z.

    It reads `size` raw numbers an item: `hidden` features of the network, then `numbers` that are added to what it
    says of every z, then `numbers × latent` that turn z. So the framework's linear layer is the first layer of all
    three and is computed once per item; a layer of z alone is added to the features, once per sample.

    The two linear paths keep a mixture over several numbers from collapsing. The shared numbers move all components at
    once, so that what each must know (an angle the image determines) does not single out the one that learnt it
    first. `spread` makes components differ from the first step, and is turned by the image: two opposite directions,
    whose mean says nothing, show in the second moment, and this path learns from it at first order.

    Args:
        latent: dimensions of z.
        hidden: width of both layers.
        numbers: what the component reads.
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
        raw = raw.to(z.dtype).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        features, shared, turned = raw.split(self.parts, -1)
        spread = self.spread + turned.unflatten(-1, self.spread.shape)
        mixed = self.body(features + self.from_latent(z))
        return mixed + shared + torch.einsum("...nl,...l->...n", spread, z)
