"""What all our losses share: twin critics with TD targets from a diffusion actor, with or without a graph encoder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.objectives import ValueEstimators
from torchrl.objectives.utils import dispatch_value_estimator, distance_loss
from torchrl.objectives.value import ValueEstimatorBase

from redig.objectives.batches import at_least_float32, check_action, dotted, per_robot, require, under_next
from redig.objectives.networks import DiffusionActorCriticNetworks

LossT = TypeVar("LossT", bound="DiffusionActorCriticLoss")


class DiffusionActorCriticLoss(DiffusionActorCriticNetworks):
    """Critics of a diffusion actor; how the actor learns from them, :meth:`actor_loss`, is each subclass's own.

    ``loss_qvalue`` (Eq. 2) is the TD error of the critics, ``y = r + gamma min(Q1', Q2')(h', a')`` with target networks
    and ``a'`` from the target actor. Rewards and done flags may be per robot, ``[*B, n, 1]``, or per team, ``[*B, 1]``;
    a team's count for each robot. Works without robots, too: ``[*B, F]``.

    ``loss.to(torch.bfloat16)`` moves the networks. Losses, TD targets, the noise schedule, bounds and the discount
    factor stay in float32 or better, and so may batches, which our networks cast to their own type.

    Args:
        encoder: TensorDictModule that writes the embedding which the actor reads, or ``None`` if actor and critic read
            observations themselves.
        actor: :class:`~redig.modules.DiffusionActor`.
        qvalue: TensorDictModule ``(embedding, action) -> state_action_value``; copied ``num_qvalue_nets`` times.

    Keyword Args:
        critic_encoder: an encoder of the critic's own (same keys). Default ``None``: one encoder, trained by both
            losses as in the paper.
        detach_encoder: keep the critic's loss from reaching the shared encoder.
        num_qvalue_nets: number of critics.
        loss_function: ``"l2"`` or ``"smooth_l1"`` for the TD error.
        reduction: ``"mean"``, ``"sum"`` or ``"none"``, which keeps the shape (0 where a robot does not count).
        deactivate_vmap: call the critics one after the other, for a critic that ``torch.vmap`` cannot run.

    Raises:
        TypeError: if the actor cannot be trained by diffusion.
        ValueError: for arguments outside their range, or ``detach_encoder`` with a separate ``critic_encoder``; on use,
            if a tensor of the batch has another shape than expected; it names the key and both shapes.
        KeyError: on use, if the batch lacks a key; it names the key and the ones that are there.

    Examples:
        >>> import torch
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor, QNetwork
        >>> class Cloning(DiffusionActorCriticLoss):
        ...     def actor_loss(self, tensordict):
        ...         error = self._action_loss(tensordict, tensordict[self.tensor_keys.action])
        ...         return error.mean(), {}
        >>> actor = DiffusionActor(DenoisingMLP(1, 3), Bounded(-2, 2, (1,)), ["observation"], ["action"])
        >>> qvalue = TensorDictModule(QNetwork(3, 1), ["observation", "action"], ["state_action_value"])
        >>> loss = Cloning(None, actor, qvalue)
        >>> loss.actor_loss(TensorDict({"observation": torch.zeros(8, 3), "action": torch.zeros(8, 1)}, [8]))[0].shape
        torch.Size([])
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename; all may be nested.

        Attributes:
            action: the action that was executed; the critic learns its value.
            state_action_value: output of the critic.
            reward, done, terminated: under ``"next"``.
            value_target: where ``write_targets`` leaves the TD targets for ``td_loss``.
            priority: where the TD error is written.
            priority_weight: optional weight of each transition, as a prioritized buffer writes it.
            demonstration: optional flag of what to imitate as it is. Like the next two, one for the team, ``[*B]`` or
                ``[*B, 1]``, or one for each robot, ``[*B, n, 1]``; flags may be of any type, 0 is false.
            actor_mask: optional flag of the robots whose action counts for the actor; false for one whose action the
                environment did not carry out, such as a robot that has arrived and holds.
            steps_to_next_obs: optional length of n-step windows.
        """

        action: NestedKey = "action"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        value_target: NestedKey = "value_target"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"
        demonstration: NestedKey = "demonstration"
        actor_mask: NestedKey = "actor_mask"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    SUPPORTED_VALUE_ESTIMATORS = (ValueEstimators.TD0, ValueEstimators.TD1, ValueEstimators.TDLambda)
    out_keys: ClassVar[list[NestedKey]] = [
        "loss_qvalue",
        "loss_actor",
        "pred_value",
        "target_value",
        "next_state_value",
    ]

    def __init__(
        self,
        encoder: TensorDictModule | None,
        actor: TensorDictModule,
        qvalue: TensorDictModule,
        *,
        critic_encoder: TensorDictModule | None = None,
        detach_encoder: bool = False,
        num_qvalue_nets: int = 2,
        loss_function: str = "l2",
        reduction: str = "mean",
        deactivate_vmap: bool = False,
    ) -> None:
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction: got {reduction!r}, allowed are mean, sum, none")
        if detach_encoder and critic_encoder is not None:
            raise ValueError("detach_encoder: a separate critic_encoder leaves no shared encoder to detach")
        if loss_function not in ("l2", "smooth_l1"):
            raise ValueError(f"loss_function: got {loss_function!r}, allowed are l2, smooth_l1")
        self._in_keys: list[NestedKey] | None = None
        super().__init__(encoder, actor, qvalue, critic_encoder, num_qvalue_nets, deactivate_vmap)
        self.detach_encoder = detach_encoder
        self.loss_function, self.reduction = loss_function, reduction

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        if self._value_estimator is not None:
            names = ("reward", "done", "terminated", "steps_to_next_obs")
            self._value_estimator.set_keys(**{name: getattr(self.tensor_keys, name) for name in names})
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that a batch must have."""
        if self._in_keys is None:
            keys, states = self.tensor_keys, self._states
            self._in_keys = [keys.action, *states, *(under_next(k) for k in states)]
            self._in_keys += [under_next(k) for k in (keys.reward, keys.done, keys.terminated)]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def make_value_estimator(
        self: LossT,
        value_type: ValueEstimators | str | ValueEstimatorBase | type[ValueEstimatorBase] | None = None,
        **hyperparams,
    ) -> LossT:
        """Choose how TD targets are made: TD0 (default; n-step with ``steps_to_next_obs``), TD1 or TD(lambda).

        Args:
            value_type: which of them, or an estimator of one's own that takes ``next_value``.
            **hyperparams: of the estimator, such as ``gamma`` and ``lmbda``.

        Raises:
            NotImplementedError: for another of TorchRL's estimators.
        """
        kind, hyperparams = self._prepare_value_estimator_kwargs(value_type, **hyperparams)
        if kind is not None:
            supported = self.SUPPORTED_VALUE_ESTIMATORS
            dispatch_value_estimator(self, kind, supported=supported, value_network=None, **hyperparams)
        self._forward_value_estimator_keys()
        return self

    @dispatch
    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Both losses of a batch; ``loss_actor`` does not depend on the critics' parameters, nor the reverse."""
        loss_qvalue, metadata = self.qvalue_loss(tensordict)
        loss_actor, actor_metadata = self.actor_loss(tensordict)
        return TensorDict({"loss_qvalue": loss_qvalue, "loss_actor": loss_actor, **metadata, **actor_metadata})

    def qvalue_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """TD error of all critics (Eq. 2), summed over critics, and what to log of it."""
        self._check(tensordict, self.in_keys)
        target, next_value = self._target_value(tensordict)
        loss, metadata = self._td_error(tensordict, target)
        return loss, {**metadata, "next_state_value": next_value.mean()}

    def write_targets(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the TD targets of a batch into it, under ``value_target``, for :meth:`td_loss`.

        The two together are :meth:`qvalue_loss`. Targets need no gradient, so those of several updates can be computed
        at once, in a batch large enough to keep the processor busy; they then share one state of the target networks.
        """
        self._check(tensordict, self.in_keys)
        return tensordict.set(self.tensor_keys.value_target, self._target_value(tensordict)[0])

    def td_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """TD error (Eq. 2) against the targets that :meth:`write_targets` left in the batch, and what to log of it."""
        key = self.tensor_keys.value_target
        self._check(tensordict, [*self._present_keys, key])
        return self._td_error(tensordict, tensordict[key])

    def _td_error(self, tensordict: TensorDictBase, target: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        keys = self.tensor_keys
        embedding = self._critic_embedding(tensordict)
        if self.detach_encoder:
            embedding = embedding.detach()
        value = self._qvalues(embedding, self._action(tensordict, keys.action, embedding), self.qvalue_network_params)
        loss = distance_loss(value, target.expand_as(value), self.loss_function).sum(0)
        tensordict[keys.priority] = (value - target).detach().abs().mean(0)
        return self._reduce(loss, tensordict, self._counted(tensordict, loss)), {
            "pred_value": value.detach().mean(),
            "target_value": target.mean(),
        }

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the actor, and what to log of it."""
        raise NotImplementedError

    @torch.no_grad()
    def value(self, tensordict: TensorDictBase) -> Tensor:
        """Value of the actions in a batch, the minimum over the critics: ``[*B, n, 1]``."""
        self._check(tensordict, self._present_keys)
        embedding, key = self._critic_embedding(tensordict), self.tensor_keys.action
        return self._qvalues(embedding, self._action(tensordict, key, embedding), self.qvalue_network_params).amin(0)

    @property
    def _present_keys(self) -> list[NestedKey]:
        """The keys of a batch that are not under ``"next"``."""
        return [key for key in self.in_keys if isinstance(key, str) or key[0] != "next"]

    def _check(self, tensordict: TensorDictBase, keys: list[NestedKey]) -> None:
        """Check the keys of the critic, then of the batch."""
        critic = self.qvalue_network
        for name, those in (("action", critic.in_keys), ("state_action_value", critic.out_keys)):
            key = getattr(self.tensor_keys, name)
            if key not in those:
                known = ", ".join(map(dotted, those))
                raise KeyError(f"{name}: got {dotted(key)}, the critic has {known}; set_keys({name}=...) renames it")
        require(tensordict, keys)

    def _action(self, tensordict: TensorDictBase, key: NestedKey, embedding: TensorDictBase) -> Tensor:
        """An action of the batch, checked against what the actor reads."""
        state = self.actor_network.in_keys[0]
        check_action(key, tensordict[key], self._bounds[0], embedding[state], state)
        return tensordict[key]

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """TD target and the value of the next state, ``[*B, n, 1]`` both."""
        keys, following = self.tensor_keys, tensordict["next"]
        actor_view = self._embed(following, "encoder_network", target=True)
        action = self._sample_action(actor_view, self.target_actor_network_params)
        critic_view = self._critic_embedding(following, target=True) if self.separate_encoders else actor_view
        next_value = self._qvalues(critic_view, action, self.target_qvalue_network_params).amin(0)
        windows = tensordict.empty()
        reward = under_next(keys.reward)
        windows[reward] = at_least_float32(per_robot(reward, tensordict[reward], next_value, tensordict.shape))
        for key in (under_next(keys.done), under_next(keys.terminated)):
            windows[key] = per_robot(key, tensordict[key].bool(), next_value, tensordict.shape)
        if keys.steps_to_next_obs in tensordict.keys(True):
            steps = tensordict[keys.steps_to_next_obs]
            windows[keys.steps_to_next_obs] = per_robot(keys.steps_to_next_obs, steps, next_value, tensordict.shape)
        return self.value_estimator.value_estimate(windows, next_value=next_value), next_value

    def _flag(self, tensordict: TensorDictBase, key: NestedKey, like: Tensor) -> Tensor | None:
        """An optional flag of the batch, as bool and for each robot: ``[*B, n, 1]`` like ``like``."""
        flag = tensordict.get(key, None)
        return None if flag is None else per_robot(key, flag.bool(), like, tensordict.shape)

    def _counted(self, tensordict: TensorDictBase, like: Tensor, mask: Tensor | None = None) -> Tensor:
        """What counts for a loss ``[*B, n, 1]``: what the mask keeps, without padding (``loss_mask_key``)."""
        counted = torch.ones_like(like, dtype=torch.bool) if mask is None else mask
        for key in self._loss_mask_keys():
            valid = tensordict.get(key, None)
            if valid is not None:
                counted = counted & self._expand_loss_mask(valid, like)
        return counted

    def _reduce(self, loss: Tensor, tensordict: TensorDictBase, counted: Tensor) -> Tensor:
        """Weighted by the priority weights; 0 where nothing counts."""
        key, weight = self.tensor_keys.priority_weight, counted.to(loss.dtype)
        given = tensordict.get(key, None) if self.use_prioritized_weights else None
        if given is not None:
            weight = weight * per_robot(key, given, loss, tensordict.shape)
        loss = weight * loss.where(counted, 0)
        if self.reduction == "none":
            return loss
        total = loss.sum()
        return total if self.reduction == "sum" else total / weight.sum().clamp_min(torch.finfo(weight.dtype).tiny)
