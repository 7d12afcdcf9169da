"""Deep ensembles: the mixture of the densities of several independently trained models."""

from collections.abc import Callable, Iterable, Sequence
from typing import Annotated, Any, cast

import torch
from jaxtyping import Float
from pydantic import Field
from torch import Tensor, nn
from torch.distributions import Distribution

from framework.data import Batch
from framework.density_head import DensityHead, Fitted
from framework.distributions.batch_shapes import Stacked
from framework.errors import ConfigError, UserError
from framework.model import Model, Predictor, SharedResult, independent_penalty, own_sample_penalty
from framework.uncertainty import Joining, SeveralModels, Uncertainty
from plugins.uncertainty.members.equal_mixture import equal_mixture
from plugins.uncertainty.members.side_by_side import SideBySide

WORTH_TRYING = (1, 2, 3, 5, 10, 20, 50)


class Ensemble(Uncertainty, Joining, SeveralModels):
    """T independently trained models; p(y|x) = (1/T) Σ_t p_t(y|x) (thesis eq. 2.17).

    They differ in initial weights and in the order of batches. If every encoder vectorises (`Encoder.vectorises`),
    their parameters are stacked and one pass trains and evaluates all; otherwise they are computed one after the other.
    In both cases each member has its own gradient, which is clipped separately, so that it trains as it would alone. An
    ensemble of one member equals the wrapped model, to the last bit.

    Attributes:
        members: number of the trained members that are used, the first ones; may be lowered after training (a knob).

    Raises:
        ConfigError: more members are used than were trained.
        UserError: a member's parameters of the density are not finite; it is named and not averaged in.
    """

    bibtex = """@inproceedings{lakshminarayanan2017simple,
  author    = {Lakshminarayanan, Balaji and Pritzel, Alexander and Blundell, Charles},
  title     = {Simple and Scalable Predictive Uncertainty Estimation using Deep Ensembles},
  booktitle = {Advances in Neural Information Processing Systems},
  pages     = {6402--6413},
  year      = {2017}
}"""

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
        if members > 1 and all(vectorises(one) for one in built):
            models = cast(list[Model], built)
            self.together = SideBySide([network(one) for one in models])
            self.heads.extend(one.head for one in (models if has_state(models[0].head) else models[:1]))
        else:
            self.apart.extend(built)

    def forward(self, inputs: Tensor) -> Distribution:
        """Return the mixture of the densities of the members in use."""
        if not 1 <= self.members <= self.model_count:
            raise ConfigError(
                f"members = {self.members} of an ensemble of {self.model_count}: wanted a number from 1 to "
                f"{self.model_count}."
            )
        if self.together is None:
            found = [self._of(index, inputs) for index in range(self.members)]
            if len(found) == 1:
                return found[0]
            components: Distribution = Stacked(found)
        else:
            components = self._densities(self.together(inputs, self.members))
        return equal_mixture(components, self, inputs.device)

    def loss(self, inputs: Tensor, target: Tensor) -> Float[Tensor, "batch"]:
        """Return the loss of each sample, nats, such that each member trains as it would alone."""
        if self.own_batches:
            return own_sample_penalty(self._own_losses(inputs, target), self.model_count)
        if self.together is None:
            losses = torch.stack([member.loss(inputs, target) for member in self._apart()], 1)
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
        """Return each member's losses of its own rows."""
        if self.together is None:
            parts = zip(self._apart(), self._parts(inputs), target.chunk(self.model_count), strict=True)
            return torch.cat([member.loss(given, wanted) for member, given, wanted in parts])
        raw = self._own_raw(inputs)
        wanted = target.unflatten(0, (self.model_count, -1))
        if len(self.heads) == 1:
            return self._head(0).loss(raw, wanted).flatten()
        return torch.cat(
            [self._head(index).loss(raw[index], wanted[index]) for index in range(self.model_count)]
        )

    def _parts(self, inputs: Tensor) -> Sequence[Tensor]:
        """Return each member's own rows: the same tensors as long as `one_pass` keeps results computed from them."""
        return self.shared_result.get_or_compute(inputs, lambda given: given.chunk(self.model_count))

    def _own_raw(self, inputs: Tensor) -> Float[Tensor, "member batch size"]:
        assert self.together is not None
        return self.together.own(inputs.unflatten(0, (self.model_count, -1)))

    def clip_each_model(self, max_norm: float) -> None:
        """Shorten each member's gradient to the norm `max_norm`."""
        for member in self.apart:
            nn.utils.clip_grad_norm_(member.parameters(), max_norm)
        if self.together is not None:
            self.together.clip_each(max_norm, list(self.heads) if len(self.heads) > 1 else [])

    def training_densities(self, inputs: Tensor) -> Distribution:
        """Return the members' densities in training, batch_shape (batch, member), or (batch,) for one."""
        if self.together is not None:
            own = self.own_batches
            return self._densities(self._own_raw(inputs).movedim(0, 1) if own else self.together(inputs))
        parts = self._parts(inputs) if self.own_batches else [inputs] * self.model_count
        found = [member.training_densities(part) for member, part in zip(self._apart(), parts, strict=True)]
        return found[0] if len(found) == 1 else Stacked(found)

    @torch.no_grad()
    def calibrate(self, batches: Iterable[Batch]) -> None:
        """Calibrate each member."""
        seen = list(batches)
        if self.together is None:
            for member in self._apart():
                member.calibrate(seen)
        elif len(self.heads) > 1:
            raw = torch.cat([self.together(batch["input"]) for batch in seen])
            target = torch.cat([batch["target"] for batch in seen])
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
                f"an ensemble of {self.model_count} was given {len(members)} members; wanted as many."
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
            return self._apart()[index](inputs)
        except ValueError as error:  # the message of a head that was given NaN names the row
            raise UserError(
                f"member {index} of {self.model_count} of the ensemble: {error} {REMEDY}"
            ) from error

    def _densities(self, raw: Float[Tensor, "batch member size"]) -> Distribution:
        """Return the members' densities, batch_shape (batch, member)."""
        bad = (~raw.isfinite()).any(-1).nonzero()
        if len(bad):
            row, index = bad[0].tolist()
            others = len(bad[:, 1].unique()) - 1
            more = f" (and {others} other members)" if others else ""
            raise UserError(
                f"member {index} of {self.model_count} of the ensemble{more} gives numbers that are not finite, first "
                f"for row {row} of the batch. {REMEDY}"
            )
        if len(self.heads) == 1:
            return self._head(0)(raw)
        return Stacked([self._head(index)(raw[:, index]) for index in range(raw.shape[1])])

    def _head(self, index: int) -> DensityHead:
        return cast(DensityHead, self.heads[index])

    def _apart(self) -> list[Predictor]:
        return cast(list[Predictor], list(self.apart))


REMEDY = (
    "It is not averaged in. Look at the inputs; if they are sound, train the ensemble again with a lower "
    "optimizer.learning_rate, or join the sound runs of a sweep with mode=combine."
)


def vectorises(member: Predictor) -> bool:
    """Return whether members like this one can be computed in one vectorised pass."""
    if not isinstance(member, Model) or isinstance(member.head, Fitted):
        return False
    if not any(
        True for _ in network(member).parameters()
    ):  # only the head has parameters: there is nothing to stack
        return False
    return all(encoder.vectorises for encoder in member.encoders)


def network(member: Model) -> nn.Sequential:
    """Return the layers from the inputs to the head's raw parameters."""
    return nn.Sequential(member.encoders, member.projection)


def has_state(head: nn.Module) -> bool:
    """Return whether the heads of two members can differ."""
    return bool(head.state_dict())
