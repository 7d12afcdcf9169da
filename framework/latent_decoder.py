"""The decoder of latent-variable density heads: features and a latent vector in, a component's raw numbers out."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

LARGEST_FEATURE = 1e6
"""Features are cut off here, so that no raw number, however large, overflows in the layers behind."""


class LatentDecoder(nn.Module):
    """Two hidden layers of (features, z), plus a path linear in the features and one linear in z.

    The first layer is linear in (features, z): the sum of the framework's linear layer, computed once per item, and
    a layer of z alone, computed once per sample. The two linear paths keep a mixture over several numbers from
    collapsing. `shared` moves all components at once, so that what each must know (an angle the image determines)
    does not single out the one that learnt it first. `spread` makes components differ from the first step, and
    `gate` turns that spread by the image: two opposite directions, whose mean says nothing, show in the second
    moment, and this path learns from it at first order.

    Args:
        latent: dimensions of z.
        hidden: numbers of the features, and the width of both layers.
        numbers: what the component reads.
    """

    def __init__(self, latent: int, hidden: int, numbers: int) -> None:
        super().__init__()
        self.from_latent = nn.Linear(latent, hidden, bias=False)
        self.body = nn.Sequential(nn.ReLU(), nn.Linear(hidden, hidden), nn.ReLU(), nn.Linear(hidden, numbers))
        self.shared = nn.Linear(hidden, numbers, bias=False)
        # each number starts as N(0, 1) over z
        self.spread = nn.Parameter(torch.randn(numbers, latent) * latent**-0.5)
        self.gate = nn.Linear(hidden, numbers * latent, bias=False)

    def forward(
        self, features: Float[Tensor, "*#batch hidden"], z: Float[Tensor, "*#batch latent"]
    ) -> Float[Tensor, "*batch numbers"]:
        features = features.to(z.dtype).clamp(-LARGEST_FEATURE, LARGEST_FEATURE)
        mixed = self.body(features + self.from_latent(z))
        active = torch.relu(features)
        spread = self.spread + self.gate(active).unflatten(-1, self.spread.shape)
        return mixed + self.shared(active) + torch.einsum("...nl,...l->...n", spread, z)
