"""Deep ensembles: the mixture of the densities of several independently trained models."""

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, cast

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.calibration.equal_mixture import equal_mixture
from framework.data import Batch
from framework.density_head import DensityHead, Fitted
from framework.distributions.batch_shapes import Stacked
from framework.errors import ConfigError, UserError
from framework.model import Model, Predictor, SharedResult, independent_penalty, own_sample_penalty
from framework.uncertainty import Joining, SeveralModels, Uncertainty
from plugins.uncertainty.members.side_by_side import SideBySide

WORTH_TRYING = (1, 2, 3, 5, 10, 20, 50)


class Ensemble(Uncertainty, Joining, SeveralModels):
    """Mixture of the densities of T independently trained models: p(y|x) = (1/T) Σ_t p_t(y|x) (thesis eq. 2.17).

    The members differ in their initial weights and in the order of their batches. If all encoders can be vectorised
    (`Encoder.vectorises`), the parameters are stacked, and one pass trains and evaluates all members. Otherwise the
    members are computed one after the other. In both cases the gradient of each member is clipped separately, so that
    the member trains as it would alone. An ensemble of one member equals the wrapped model, to the last bit.

    Attributes:
        members: number of members that are used, counted from the first; may be lowered after training (a knob).

    Raises:
        ConfigError: more members are used than were trained.
        UserError: the distribution parameters of a member are not finite; the message names the member.
    """

    bibtex = "lakshminarayanan2017simple"

    def __init__(self, model: Callable[[], Predictor], *, members: Annotated[int, Field(ge=1)] = 5) -> None:
        super().__init__()
        self.model_count = members
        self.members = members
        self.knobs = {"members": tuple(count for count in WORTH_TRYING if count <= members)}
        self.shared_result: SharedResult[Sequence[Tensor]] = SharedResult()
        built = [model() for _ in range(members)]
        self.apart = nn.ModuleList()
        self.heads = nn.ModuleList()
        self.together: SideBySide | None = None
        if members > 1 and all(vectorises(model) for model in built):
            models = cast(list[Model], built)
            self.together = SideBySide([network(model) for model in models])
            self.heads.extend(model.head for model in (models if has_state(models[0].head) else models[:1]))
        else:
            self.apart.extend(built)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the mixture of the densities of the members in use."""
        if not 1 <= self.members <= self.model_count:
            raise ConfigError(
                f"uncertainty.ensemble.members is {self.members}, expected a number from 1 to {self.model_count}, the "
                "number of trained members."
            )
        if self.together is None:
            densities = [self._of(index, inputs) for index in range(self.members)]
            if len(densities) == 1:
                return densities[0]
            components: Distribution = Stacked(densities)
        else:
            components = self._densities(self.together(inputs, self.members))
        return equal_mixture(components, self, inputs.device)

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the loss of each sample, nats; its gradient trains each member as the member would train alone."""
        if self.own_batches:
            return own_sample_penalty(self._own_losses(inputs, target), self.model_count)
        if self.together is None:
            losses = torch.stack([member.loss(inputs, target) for member in self._separate_members()], 1)
        else:
            raw = self.together(inputs)
            if len(self.heads) == 1:
                wide = target.unsqueeze(1).expand(target.shape[0], self.model_count, *target.shape[1:])
                losses = self._head(0).loss(raw, wide)
            else:
                parts = [self._head(index).loss(raw[:, index], target) for index in range(self.model_count)]
                losses = torch.stack(parts, 1)
        return independent_penalty(losses)

    def _own_losses(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the loss of each sample; each member computes only the losses of its own part of the batch."""
        if self.together is None:
            parts = zip(
                self._separate_members(), self._parts(inputs), target.chunk(self.model_count), strict=True
            )
            return torch.cat([member.loss(part, wanted) for member, part, wanted in parts])
        raw = self._own_raw(inputs)
        wanted = target.unflatten(0, (self.model_count, -1))
        if len(self.heads) == 1:
            return self._head(0).loss(raw, wanted).flatten()
        return torch.cat(
            [self._head(index).loss(raw[index], wanted[index]) for index in range(self.model_count)]
        )

    def _parts(self, inputs: Tensor) -> Sequence[Tensor]:
        """Return the part of `inputs` that each member sees.

        Inside `one_pass`, later calls with the same inputs return the same tensors.
        """
        return self.shared_result.get_or_compute(inputs, lambda batch: batch.chunk(self.model_count))

    def _own_raw(self, inputs: Tensor) -> Float[Tensor, "member batch *raw"]:
        assert self.together is not None
        return self.together.own(inputs.unflatten(0, (self.model_count, -1)))

    def clip_each_model(self, max_norm: float) -> None:
        """Scale the gradient of each member down to the norm `max_norm` if it is longer."""
        for member in self.apart:
            nn.utils.clip_grad_norm_(member.parameters(), max_norm)
        if self.together is not None:
            self.together.clip_each(max_norm, list(self.heads) if len(self.heads) > 1 else [])

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the densities of all trained members, batch_shape (batch, member), or (batch,) for a single member."""
        if self.together is not None:
            own = self.own_batches
            return self._densities(self._own_raw(inputs).movedim(0, 1) if own else self.together(inputs))
        parts = self._parts(inputs) if self.own_batches else [inputs] * self.model_count
        densities = [
            member.training_densities(part)
            for member, part in zip(self._separate_members(), parts, strict=True)
        ]
        return densities[0] if len(densities) == 1 else Stacked(densities)

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate each member."""
        kept_batches = list(batches)
        if self.together is None:
            for member in self._separate_members():
                member.calibrate(kept_batches)
        elif len(self.heads) > 1:
            raw = torch.cat([self.together(batch["input"]) for batch in kept_batches])
            target = torch.cat([batch["target"] for batch in kept_batches])
            for index in range(self.model_count):
                self._head(index).calibrate(raw[:, index], target)

    @classmethod
    def parameters_of(cls, count: int) -> dict[str, Any]:
        """Return the constructor arguments of an ensemble of `count` members."""
        return {"members": count}

    def join(self, members: Sequence[Predictor]) -> None:
        """Copy the state of separately trained members into this ensemble."""
        if len(members) != self.model_count:
            raise ConfigError(
                f"Got {len(members)} members for an ensemble of {self.model_count}, but these numbers must be equal. "
                f"Build the ensemble with members={len(members)}."
            )
        for index, member in enumerate(members):
            if self.together is None:
                self.apart[index].load_state_dict(member.state_dict())
            else:
                assert isinstance(member, Model)
                self.together.write(index, dict(network(member).named_parameters()))
                if len(self.heads) > 1:
                    self.heads[index].load_state_dict(member.head.state_dict())

    def _of(self, index: int, inputs: Tensor) -> Distribution:
        try:
            return self._separate_members()[index](inputs)
        except ValueError as error:  # a head's message about NaN names the row
            raise UserError(
                f"Member {index} of {self.model_count} of the ensemble: {error} {REMEDY}"
            ) from error

    def _densities(self, raw: Float[Tensor, "batch member *raw"]) -> Distribution:
        """Return the densities of the members with the raw parameters `raw`, batch_shape (batch, member)."""
        # the trace of an exported model depends on no value
        bad = raw if torch.compiler.is_exporting() else (~raw.isfinite()).flatten(2).any(-1).nonzero()
        if bad is not raw and len(bad):
            row, index = bad[0].tolist()
            other_members = len(bad[:, 1].unique()) - 1
            more = f" (and {other_members} other members)" if other_members else ""
            raise UserError(
                f"Member {index} of {self.model_count} of the ensemble{more} gives distribution parameters that are "
                f"not finite, first for row {row} of the batch. {REMEDY}"
            )
        if len(self.heads) == 1:
            return self._head(0)(raw)
        return Stacked([self._head(index)(raw[:, index]) for index in range(raw.shape[1])])

    def _head(self, index: int) -> DensityHead:
        return cast(DensityHead, self.heads[index])

    def _separate_members(self) -> list[Predictor]:
        return cast(list[Predictor], list(self.apart))


REMEDY = (
    "Such a member is never averaged with the others. Check the inputs; if the inputs are valid, train the ensemble "
    "again with a lower optimizer.learning_rate, or combine only the runs of a sweep that succeeded, with mode=combine."
)


def vectorises(member: Predictor) -> bool:
    """Return whether several members of this architecture can be computed in one vectorised pass."""
    if not isinstance(member, Model) or isinstance(member.head, Fitted):
        return False
    if not any(True for _ in network(member).parameters()):
        return False  # only the head has parameters: there is nothing to stack
    return all(encoder.vectorises for encoder in member.encoders)


def network(member: Model) -> nn.Sequential:
    """Return the layers from the inputs to the head's raw parameters."""
    return nn.Sequential(member.encoders, member.projection)


def has_state(head: nn.Module) -> bool:
    """Return whether the head has parameters or buffers, so that the heads of two members can differ."""
    return bool(head.state_dict())
