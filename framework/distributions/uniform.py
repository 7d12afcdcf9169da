"""The uniform distribution over the support that a density declares."""

import math
from functools import singledispatch

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, constraints

from framework.distributions import protocol
from framework.distributions.batch_shapes import Reshaped, Stacked
from framework.distributions.circular import Circular, circular
from framework.distributions.density import Mixture
from framework.distributions.description import PlainDensity
from framework.distributions.shapes import broadcast_shapes
from framework.errors import UserError


@singledispatch
def uniform(density: Distribution) -> Distribution:
    """Return the uniform distribution over the support of a density, with the same shapes.

    Parts of the support of equal size are equally likely. The default is known for classes, and for angles that each
    cover the whole circle. If the angles of a density are coordinates of another space (rotations, for example), the
    density registers the distribution that is uniform on that space.

    Raises:
        UserError: no distribution is uniform over the support, or the density has not registered one.
    """
    if density.has_enumerate_support and density.event_shape == ():
        return Categorical(
            logits=torch.zeros_like(density.log_prob(density.enumerate_support())).movedim(0, -1),
            validate_args=False,
        )
    support = density.support
    if isinstance(support, Circular) and support.ranges is None:
        # a trace, which cannot draw, reads the shape alone
        like = torch.empty(0) if torch.compiler.is_exporting() else density.sample(torch.Size((0,)))
        return UniformAngles(like, density.batch_shape, density.event_shape)
    raise UserError(
        f"{type(density).__name__} has no uniform distribution over its support that the framework knows. Uniform "
        "distributions are known for classes, for angles over the whole circle, and for densities that register one "
        "with `framework.distributions.uniform.uniform.register`. Register one, or leave out the plugin that needs it."
    )


class UniformAngles(PlainDensity):
    """Independent angles, each uniform over the whole circle.

    Args:
        like: any tensor with the samples' number type and device.
        batch_shape: batch_shape of the distribution.
        event_shape: event_shape of the distribution, (number of angles,).
    """

    def __init__(self, like: Tensor, batch_shape: torch.Size, event_shape: torch.Size) -> None:
        self.like = like
        super().__init__(batch_shape, event_shape, validate_args=False)

    @property
    def support(self) -> constraints.Constraint:
        return circular

    @property
    def mode(self) -> Tensor:
        return self.like.new_zeros(self.batch_shape + self.event_shape)

    def log_prob(self, value: Tensor) -> Tensor:
        return -self.entropy().expand(broadcast_shapes(value.shape[:-1], self.batch_shape))

    def sample(self, sample_shape: torch.Size | tuple[int, ...] = ()) -> Tensor:
        shape = torch.Size(sample_shape) + self.batch_shape + self.event_shape
        return (2 * torch.rand(shape, dtype=self.like.dtype, device=self.like.device) - 1) * math.pi

    def entropy(self) -> Tensor:
        return self.like.new_full(self.batch_shape, self.event_shape.numel() * math.log(2 * math.pi))


@uniform.register
def _(density: Mixture) -> Distribution:
    return Mixture(density.log_weights, uniform(density.components))


@uniform.register
def _(density: Stacked) -> Distribution:
    return Stacked([uniform(inner) for inner in density.densities])


@uniform.register
def _(density: Reshaped) -> Distribution:
    return Reshaped(uniform(density.density), density.batch_shape)


protocol.estimate.register(UniformAngles, protocol.exact_estimate)


@protocol.marginal.register
def _(density: UniformAngles, index: int) -> UniformAngles:
    return UniformAngles(density.like, density.batch_shape, torch.Size((1,)))


@protocol.pick.register
def _(density: UniformAngles, index: Tensor) -> UniformAngles:
    return UniformAngles(density.like, index.shape, density.event_shape)


@protocol.recentre.register
def _(density: UniformAngles, index: tuple[Tensor, ...], origin: Tensor) -> UniformAngles:
    shape = broadcast_shapes(origin.shape[:-1], *(part.shape for part in index))
    return UniformAngles(origin, shape, density.event_shape)


@protocol.arc_probability.register
def _(density: UniformAngles, start: Tensor, end: Tensor) -> Tensor:
    return protocol.arc_length(start, end).squeeze(-1) / (2 * math.pi)
