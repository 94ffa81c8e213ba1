"""What all our losses share: twin critics with TD targets from a diffusion actor, with or without a graph encoder."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, TypeVar

import torch
from tensordict import TensorDict, TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule, dispatch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule, ValueEstimators
from torchrl.objectives.utils import _vmap_func, default_value_kwargs, distance_loss
from torchrl.objectives.value import TD0Estimator, TD1Estimator, TDLambdaEstimator

_ESTIMATORS = {
    ValueEstimators.TD0: TD0Estimator,
    ValueEstimators.TD1: TD1Estimator,
    ValueEstimators.TDLambda: TDLambdaEstimator,
}
LossT = TypeVar("LossT", bound="DiffusionActorCriticLoss")


class DiffusionActorCriticLoss(LossModule):
    """Critics of a diffusion actor; how the actor learns from them, :meth:`actor_loss`, is each subclass's own.

    ``loss_qvalue`` (Eq. 2) is the TD error of the critics, ``y = r + gamma min(Q1', Q2')(h', a')`` with target networks
    and ``a'`` from the target actor. Rewards and done flags may be per robot, ``[*B, n, 1]``, or per team, ``[*B, 1]``;
    a team's count for each robot. Works without robots, too: ``[*B, F]``.

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
        reduction: ``"mean"``, ``"sum"`` or ``"none"``.

    Raises:
        ValueError: for arguments outside their range, or ``detach_encoder`` with a separate ``critic_encoder``.
        KeyError: on use, if the batch lacks a key; it names the key and the ones that are there.
    """

    @dataclass
    class _AcceptedKeys:
        """Keys that ``set_keys`` can rename; all may be nested.

        Attributes:
            action: the action that was executed; the critic learns its value.
            state_action_value: output of the critic.
            reward, done, terminated: under ``"next"``.
            priority: where the TD error is written.
            demonstration: flag of transitions to imitate as they are.
            actor_mask: optional flag ``[*B, n, 1]`` of the robots whose action counts for the actor; false for one
                whose action the environment did not carry out, such as a robot that has arrived and holds.
            steps_to_next_obs: length of n-step windows.
        """

        action: NestedKey = "action"
        state_action_value: NestedKey = "state_action_value"
        reward: NestedKey = "reward"
        done: NestedKey = "done"
        terminated: NestedKey = "terminated"
        priority: NestedKey = "td_error"
        priority_weight: NestedKey = "priority_weight"
        demonstration: NestedKey = "demonstration"
        actor_mask: NestedKey = "actor_mask"
        steps_to_next_obs: NestedKey = "steps_to_next_obs"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    default_value_estimator = ValueEstimators.TD0
    # a diffusion target policy that starts from a zero latent is not the policy: sample it
    deterministic_sampling_mode = ExplorationType.RANDOM
    out_keys: ClassVar[list[NestedKey]] = [
        "loss_qvalue",
        "loss_actor",
        "pred_value",
        "target_value",
        "next_state_value",
    ]

    encoder_network: TensorDictModule
    encoder_network_params: TensorDictParams
    target_encoder_network_params: TensorDictParams
    critic_encoder_network: TensorDictModule
    critic_encoder_network_params: TensorDictParams
    target_critic_encoder_network_params: TensorDictParams
    actor_network: TensorDictModule
    actor_network_params: TensorDictParams
    target_actor_network_params: TensorDictParams
    qvalue_network: TensorDictModule
    qvalue_network_params: TensorDictParams
    target_qvalue_network_params: TensorDictParams

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
    ) -> None:
        if num_qvalue_nets < 1:
            raise ValueError(f"num_qvalue_nets: got {num_qvalue_nets}, must be at least 1")
        if reduction not in ("mean", "sum", "none"):
            raise ValueError(f"reduction: got {reduction!r}, allowed are mean, sum, none")
        if critic_encoder is not None and encoder is None:
            raise ValueError("critic_encoder: without an encoder of the actor, put it into the critic's own network")
        if detach_encoder and critic_encoder is not None:
            raise ValueError("detach_encoder: a separate critic_encoder leaves no shared encoder to detach")
        if loss_function not in ("l2", "smooth_l1"):
            raise ValueError(f"loss_function: got {loss_function!r}, allowed are l2, smooth_l1")
        self._in_keys: list[NestedKey] | None = None
        super().__init__()
        self.has_encoder, self.separate_encoders = encoder is not None, critic_encoder is not None
        if encoder is not None:
            self.convert_to_functional(encoder, "encoder_network", create_target_params=True)
        if critic_encoder is not None:
            self.convert_to_functional(critic_encoder, "critic_encoder_network", create_target_params=True)
        self.convert_to_functional(actor, "actor_network", create_target_params=True)
        self.convert_to_functional(qvalue, "qvalue_network", num_qvalue_nets, create_target_params=True)
        self.detach_encoder = detach_encoder
        self.loss_function, self.reduction = loss_function, reduction
        self._make_vmap()

    def _make_vmap(self) -> None:
        self._vmap_qvalue = _vmap_func(self.qvalue_network, (None, 0), randomness=self.vmap_randomness)

    def _forward_value_estimator_keys(self, **kwargs) -> None:
        if self._value_estimator is not None:
            self._value_estimator.set_keys(reward="reward", done="done", terminated="terminated")
        self._in_keys = None

    @property
    def in_keys(self) -> list[NestedKey]:
        """Keys that a batch must have."""
        if self._in_keys is None:
            keys, first = self.tensor_keys, self.encoder_network if self.has_encoder else self.actor_network
            states = list(dict.fromkeys([*first.in_keys, *filter(self._is_state, self.qvalue_network.in_keys)]))
            self._in_keys = [keys.action, *states, *(_under_next(k) for k in states)]
            self._in_keys += [_under_next(k) for k in (keys.reward, keys.done, keys.terminated)]
        return self._in_keys

    @in_keys.setter
    def in_keys(self, values: list[NestedKey]) -> None:
        self._in_keys = values

    def _is_state(self, key: NestedKey) -> bool:
        return key != self.tensor_keys.action and not (self.has_encoder and key in self.encoder_network.out_keys)

    def make_value_estimator(self: LossT, value_type: ValueEstimators | None = None, **hyperparams) -> LossT:
        """Choose how TD targets are made: TD0 (default; n-step with ``steps_to_next_obs``), TD1 or TD(lambda)."""
        value_type = value_type or self.default_value_estimator
        if value_type not in _ESTIMATORS:
            raise ValueError(f"value_type: got {value_type}, allowed are {', '.join(str(v) for v in _ESTIMATORS)}")
        self.value_type = value_type
        hyperparams = {**default_value_kwargs(value_type), **hyperparams}
        if hasattr(self, "gamma"):
            hyperparams["gamma"] = self.gamma
        self._value_estimator = _ESTIMATORS[value_type](value_network=None, **hyperparams)
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
        keys = self.tensor_keys
        self._require(tensordict, self.in_keys)
        target, next_value = self._target_value(tensordict)
        embedding = self._critic_embedding(tensordict)
        if self.detach_encoder:
            embedding = embedding.detach()
        value = self._qvalues(embedding, tensordict[keys.action], self.qvalue_network_params)
        loss = distance_loss(value, target.expand_as(value), self.loss_function)
        tensordict[keys.priority] = (value - target).detach().abs().mean(0)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce(loss.sum(0), tensordict, weights)
        return loss, {
            "pred_value": value.detach().mean(),
            "target_value": target.mean(),
            "next_state_value": next_value.mean(),
        }

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Loss of the actor, and what to log of it."""
        raise NotImplementedError

    @property
    def _present_keys(self) -> list[NestedKey]:
        """The keys of a batch that are not under ``"next"``."""
        return [key for key in self.in_keys if isinstance(key, str) or key[0] != "next"]

    def _require(self, tensordict: TensorDictBase, keys: list[NestedKey]) -> None:
        missing = [key for key in keys if key not in tensordict.keys(True)]
        if missing:
            there = sorted(map(str, tensordict.keys(True, True)))
            raise KeyError(f"batch: no key {', '.join(map(str, missing))} (rename with set_keys); it has {there}")

    def _embed(self, tensordict: TensorDictBase, name: str, target: bool = False) -> TensorDictBase:
        """What a network reads: the encoder's output beside the observations, or these where there is no encoder."""
        if not self.has_encoder:
            return tensordict
        network = getattr(self, name)
        params = getattr(self, f"target_{name}_params" if target else f"{name}_params")
        beside = [*self.actor_network.in_keys, *filter(self._is_state, self.qvalue_network.in_keys)]
        with params.to_module(network, preserve_module_state=False):
            return network(tensordict.select(*network.in_keys, *beside, strict=False))

    def _critic_embedding(self, tensordict: TensorDictBase, target: bool = False) -> TensorDictBase:
        name = "critic_encoder_network" if self.separate_encoders else "encoder_network"
        return self._embed(tensordict, name, target)

    def _denoising_error(self, embedding: TensorDictBase, action: Tensor) -> Tensor:
        """Diffusion loss of the actor on given actions (Eq. 1): ``[*B, n, 1]``."""
        keys = getattr(self.actor_network, "embedding_keys", self.actor_network.in_keys)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            return self.actor_network.module.denoising_error(action, *(embedding[key] for key in keys)).unsqueeze(-1)

    def _sample_action(self, embedding: TensorDictBase, params: TensorDictParams) -> Tensor:
        with (
            set_exploration_type(self.deterministic_sampling_mode),
            params.to_module(self.actor_network, preserve_module_state=False),
        ):
            sampled = self.actor_network(embedding.select(*self.actor_network.in_keys))
        return sampled[self.actor_network.out_keys[0]]

    def _qvalues(self, embedding: TensorDictBase, action: Tensor, params: TensorDictBase) -> Tensor:
        """Values of all critics: ``[critics, *B, n, 1]``."""
        inputs = embedding.select(*self.qvalue_network.in_keys, strict=False)
        inputs[self.tensor_keys.action] = action
        return self._vmap_qvalue(inputs, params)[self.tensor_keys.state_action_value]

    @torch.no_grad()
    def _target_value(self, tensordict: TensorDictBase) -> tuple[Tensor, Tensor]:
        """TD target and the value of the next state, ``[*B, n, 1]`` both."""
        keys, following = self.tensor_keys, tensordict["next"]
        actor_view = self._embed(following, "encoder_network", target=True)
        action = self._sample_action(actor_view, self.target_actor_network_params)
        critic_view = self._critic_embedding(following, target=True) if self.separate_encoders else actor_view
        next_value = self._qvalues(critic_view, action, self.target_qvalue_network_params).amin(0)
        data = {
            name: _per_robot(_under_next(key), following[key], next_value)
            for name, key in (("reward", keys.reward), ("done", keys.done), ("terminated", keys.terminated))
        }
        windows = TensorDict({"next": data}, tensordict.shape)
        steps = tensordict.get(keys.steps_to_next_obs, None)
        if steps is not None:
            windows["steps_to_next_obs"] = _per_robot(keys.steps_to_next_obs, steps, next_value)
        return self.value_estimator.value_estimate(windows, next_value=next_value), next_value

    def _reduce(
        self, loss: Tensor, tensordict: TensorDictBase, weights: Tensor | None, mask: Tensor | None = None
    ) -> Tensor:
        if weights is not None:
            weights = weights.reshape(*tensordict.shape, *[1] * (loss.ndim - tensordict.ndim)).expand_as(loss)
        return self._reduce_loss(loss, tensordict=tensordict, weights=weights, mask=mask)


def _under_next(key: NestedKey) -> NestedKey:
    return ("next", key) if isinstance(key, str) else ("next", *key)


def _per_robot(key: NestedKey, value: Tensor, like: Tensor) -> Tensor:
    """A team's number ``[*B, 1]`` for each of its robots ``[*B, n, 1]``; a robot's own is left as it is."""
    if value.shape == like.shape:
        return value
    if value.shape == (*like.shape[:-2], 1):
        return value.unsqueeze(-2).expand_as(like)
    raise ValueError(
        f"{key}: got shape {list(value.shape)}, expected {list(like.shape)}, one number for each value of the critic, "
        f"or {[*like.shape[:-2], 1]} for the whole team"
    )
