"""The decoder of latent-variable density heads: features and a latent vector give a component's raw parameters."""

import torch
from jaxtyping import Float
from torch import Tensor, nn

LARGEST_FEATURE = 1e6
"""Bound to which features are clamped, so that no raw parameter overflows in the layers that follow."""


class LatentDecoder(nn.Module):
    """Network of two hidden layers that computes a component's raw parameters from features and a latent vector z.

    Two linear paths lead past the hidden layers: a linear function of the features and a linear function of z are added
    to the output.

    For each item of a batch, the decoder reads `size` numbers, which the framework's linear layer computes once for all
    z. They are, in this order:

    - `hidden` features. A linear function of z is added to them before the first ReLU.
    - `numbers` values, the linear path from the features. They are added to the output for every z.
    - `numbers × latent` values. They are added to the matrix `spread`, by which the other linear path multiplies z.

    Without the two linear paths, the components of a mixture over several numbers may become equal during the training.
    The path from the features shifts all components together. Therefore a property that all components have to learn
    (such as an angle that the image determines) does not favour the component that learns it first. The path from z
    makes the components differ from the first step on. With this path, the network also learns a target that points in
    one of two opposite directions with equal probability. The mean of such a target is 0 and says nothing about the
    directions, but its second moment does, and the gradient of `spread` depends on the second moment.

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
