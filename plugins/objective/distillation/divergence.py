"""Divergence of a student's density from a teacher's, for every kind of target."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.distributions import Distribution


def from_teacher(teacher: Distribution, student: Distribution, draws: int) -> Float[Tensor, "batch *member"]:
    """Return KL(p ‖ q) = E_p[log p(y) - log q(y)] of the student's density q from the teacher's density p, nats.

    For classes the sum over all classes is exact (Hinton, Vinyals & Dean 2015, eq. 2, plus a constant). For other
    targets it is the mean over `draws` targets from p, an unbiased estimate, which may be slightly below 0. It is
    exactly 0 for q = p. All members of the student get the same targets.

    Args:
        teacher: p, batch_shape (batch,); no gradient flows to it.
        student: q, batch_shape (batch,) or (batch, member).
        draws: number of targets for each sample of the batch.
    """
    members = len(student.batch_shape) - 1
    if student.has_enumerate_support:
        log_q = student.log_prob(student.enumerate_support())
        with torch.no_grad():
            log_p = teacher.log_prob(teacher.enumerate_support()).to(log_q)
        log_p = log_p.reshape(*log_p.shape, *(1,) * members)
        # p log p → 0 as p → 0; log p is clamped, because 0 × ∞ would be NaN where p rounds to 0
        return (log_p.exp() * (log_p.clamp(min=-1e4) - log_q)).sum(0)
    dtype = student.sample(torch.Size((0,))).dtype  # an empty sample has the density's dtype
    with torch.no_grad():
        targets = teacher.sample(torch.Size((draws,)))
        log_p = teacher.log_prob(targets)
    between = targets.dim() - len(teacher.event_shape)
    for _ in range(members):
        targets, log_p = targets.unsqueeze(between), log_p.unsqueeze(-1)
    log_q = student.log_prob(targets.to(dtype))
    return (log_p.to(log_q) - log_q).mean(0)
