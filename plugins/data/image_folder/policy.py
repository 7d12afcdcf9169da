"""Published policies that vary training images, from kornia."""

from functools import cache
from importlib.util import find_spec
from typing import Literal

from jaxtyping import Float, Shaped
from torch import Tensor, nn

from framework.errors import ConfigError

Policy = Literal["trivial", "random"]
"""Name of a policy: one random operation for each batch (TrivialAugment), or two (RandAugment)."""


def require_package(policy: Policy | None) -> None:
    """Refuse a policy if kornia is not installed.

    Raises:
        ConfigError: kornia is missing.
    """
    if policy is not None and find_spec("kornia") is None:
        raise ConfigError(
            f"data.policy={policy} needs the package kornia, which is not installed. Run `pip install "
            "'robust-visual-learning[augment]'`, or leave data.policy out."
        )


@cache
def load_policy(name: Policy) -> nn.Module:
    """Return kornia's module of a policy, with kornia's default operations and strengths."""
    from kornia.augmentation import auto  # takes 0.7 s, which a run without a policy does not need

    return auto.TrivialAugment() if name == "trivial" else auto.RandAugment(n=2, m=10)


def vary_images(
    images: Shaped[Tensor, "batch channels height width"], policy: Policy
) -> Float[Tensor, "batch channels height width"]:
    """Return images that were varied at random by a policy, with values in 0…1.

    The operations shift, turn, shear or recolour. Random numbers come from torch's global generator.

    Args:
        images: bytes, or numbers in 0…1, with 1 or 3 channels.
        policy: name of the policy.
    """
    fractions = images if images.is_floating_point() else images / 255
    varied = load_policy(policy)(fractions.expand(-1, 3, -1, -1))  # some operations read three channels
    return (varied if images.shape[1] == 3 else varied.mean(1, keepdim=True)).clamp(0, 1)
