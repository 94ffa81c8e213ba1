"""The networks of our losses as functions of their parameters: encoders, actor, critics, and their targets."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TypeVar

import torch
from tensordict import TensorDictBase, TensorDictParams
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import LossModule
from torchrl.objectives.utils import _vmap_func

from redig.modules.bounded import BoundedPolicy
from redig.modules.schedule import NoiseSchedule
from redig.objectives.batches import HALF, at_least_float32

NetworksT = TypeVar("NetworksT", bound="DiffusionActorCriticNetworks")


class DiffusionActorCriticNetworks(LossModule):
    """What :class:`~redig.objectives.DiffusionActorCriticLoss` computes with; see there for the arguments.

    The keys ``action`` and ``state_action_value`` of ``tensor_keys`` say where the critic reads and writes.

    Examples:
        >>> from redig.objectives import DIPOLoss
        >>> issubclass(DIPOLoss, DiffusionActorCriticNetworks)
        True
    """

    # a diffusion target policy that starts from a zero latent is not the policy: sample it
    deterministic_sampling_mode = ExplorationType.RANDOM

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
        critic_encoder: TensorDictModule | None,
        num_qvalue_nets: int,
        deactivate_vmap: bool,
    ) -> None:
        policy = getattr(actor, "module", None)
        missing = [name for name in ("action_loss", "low", "high") if not hasattr(policy, name)]
        if missing:
            raise TypeError(
                f"actor: got {type(actor).__name__} whose module has no {', '.join(missing)}; give a DiffusionActor"
            )
        if num_qvalue_nets < 1:
            raise ValueError(f"num_qvalue_nets: got {num_qvalue_nets}, must be at least 1")
        if critic_encoder is not None and encoder is None:
            raise ValueError("critic_encoder: without an encoder of the actor, put it into the critic's own network")
        super().__init__()
        self.has_encoder, self.separate_encoders = encoder is not None, critic_encoder is not None
        if encoder is not None:
            self.convert_to_functional(encoder, "encoder_network", create_target_params=True)
        if critic_encoder is not None:
            self.convert_to_functional(critic_encoder, "critic_encoder_network", create_target_params=True)
        self.convert_to_functional(actor, "actor_network", create_target_params=True)
        self.convert_to_functional(qvalue, "qvalue_network", num_qvalue_nets, create_target_params=True)
        self.deactivate_vmap = deactivate_vmap
        self._make_vmap()

    def _make_vmap(self) -> None:
        self._vmap_qvalue = _vmap_func(
            self.qvalue_network, (None, 0), randomness=self.vmap_randomness, pseudo_vmap=self.deactivate_vmap
        )

    def _apply(self: NetworksT, fn: Callable[[Tensor], Tensor]) -> NetworksT:
        """As ``nn.Module``; what has to stay precise goes to another device, but never below float32."""
        precise = {id(buffer) for buffer in self._precise_buffers()}

        def move(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            return tensor.to(moved.device) if id(tensor) in precise and moved.dtype in HALF else moved

        return super()._apply(move)

    def _precise_buffers(self) -> Iterator[Tensor]:
        """Schedule and bounds of the actor and its target, as functional parameters hold them, and gamma and lambda."""
        names = [
            f"{path}.{name}"
            for path, module in self.actor_network.named_modules()
            if isinstance(module, (BoundedPolicy, NoiseSchedule))
            for name in module._buffers
        ]
        for params in (self._modules["actor_network_params"], self._modules["target_actor_network_params"]):
            buffers = dict(params.named_buffers())
            yield from (buffers[name] for name in names)
        if self._value_estimator is not None:
            yield from self._value_estimator.buffers()

    @property
    def _bounds(self) -> tuple[Tensor, Tensor]:
        """Lower and upper bounds of the action, ``[A]`` both; those of the parameters follow the loss's device."""
        return self.actor_network_params["module", "low"], self.actor_network_params["module", "high"]

    @property
    def _states(self) -> list[NestedKey]:
        """Keys that the networks read from a batch, beside the action."""
        encoders = [
            getattr(self, name) for name in ("encoder_network", "critic_encoder_network") if name in self.__dict__
        ]
        read = [key for network in (*encoders, self.actor_network, self.qvalue_network) for key in network.in_keys]
        made = [self.tensor_keys.action, *(key for encoder in encoders for key in encoder.out_keys)]
        return list(dict.fromkeys(key for key in read if key not in made))

    def _embed(self, tensordict: TensorDictBase, name: str, target: bool = False) -> TensorDictBase:
        """What a network reads: the encoder's output beside the observations, or these where there is no encoder."""
        if not self.has_encoder:
            return tensordict
        network = getattr(self, name)
        params = getattr(self, f"target_{name}_params" if target else f"{name}_params")
        with params.to_module(network, preserve_module_state=False):
            return network(tensordict.select(*network.in_keys, *self._states, strict=False))

    def _critic_embedding(self, tensordict: TensorDictBase, target: bool = False) -> TensorDictBase:
        name = "critic_encoder_network" if self.separate_encoders else "encoder_network"
        return self._embed(tensordict, name, target)

    def _action_loss(self, embedding: TensorDictBase, action: Tensor) -> Tensor:
        """Diffusion loss of the actor on given actions (Eq. 1): ``[*B, n, 1]``."""
        keys = getattr(self.actor_network, "embedding_keys", self.actor_network.in_keys)
        with self.actor_network_params.to_module(self.actor_network, preserve_module_state=False):
            return self.actor_network.module.action_loss(action, *(embedding[key] for key in keys)).unsqueeze(-1)

    @torch.no_grad()
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
        weight = next(self.qvalue_network_params.parameters(), action)
        inputs[self.tensor_keys.action] = action.to(weight.dtype)  # the actor gives float32, whatever its own type
        return at_least_float32(self._vmap_qvalue(inputs, params)[self.tensor_keys.state_action_value])
