"""Q-weighted diffusion losses: the policy learns its own samples, the better ones more (QVPO, DPMD)."""

from __future__ import annotations

from typing import ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from redig.objectives.actor_critic import DiffusionActorCriticLoss

WEIGHTINGS = ("advantage", "exponential")


class QWeightedLoss(DiffusionActorCriticLoss):
    """Diffusion loss on the policy's own samples, weighted by the critics; needs no gradient of the critics.

    For each state ``num_candidates`` actions are drawn from the actor and valued by ``Q = min(Q1, Q2)``. Then

    * ``"advantage"`` (QVPO, Ding et al., 2024): the best of them is learned with weight ``Q - V >= 0``, where ``V`` is
      the mean over the candidates; weights are scaled to a mean of 1 in a batch. ``entropy_weight`` times the diffusion
      loss of actions drawn uniformly from the bounds is added, which keeps the policy exploring.
    * ``"exponential"`` (DPMD, Ma et al., 2025): all are learned with weights ``softmax(Q / temperature)`` over the
      candidates, a step of policy mirror descent, ``pi_new ~ pi_old exp(Q / temperature)``; ``Q`` is divided by its
      standard deviation over candidates (root mean square over the batch), so that the temperature has no units.

    Critics, encoders and keys are those of :class:`~redig.objectives.DIPOLoss`. Transitions flagged ``demonstration``
    are imitated as they are, with weight 1.

    Args:
        encoder, actor, qvalue: see :class:`~redig.objectives.DiffusionActorCriticLoss`.

    Keyword Args:
        weighting: ``"advantage"`` or ``"exponential"``.
        num_candidates: actions drawn for each state, at least 2.
        temperature: of ``"exponential"``.
        entropy_weight: of ``"advantage"``.
        **options: see :class:`~redig.objectives.DiffusionActorCriticLoss`.

    Forward writes ``td_error`` into its input and returns ``loss_qvalue``, ``loss_actor``, ``pred_value``,
    ``target_value``, ``next_state_value`` and ``candidate_gap``, by how much the best candidate beats the mean.

    Raises:
        ValueError: for arguments outside their range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DDPM, DenoisingMLP, DiffusionActor, QNetwork
        >>> keys = {"in_keys": ["observation"], "out_keys": ["action"]}
        >>> actor = DiffusionActor(DenoisingMLP(1, 3), Bounded(-2, 2, (1,)), sampler=DDPM(num_steps=5), **keys)
        >>> qvalue = TensorDictModule(QNetwork(3, 1), ["observation", "action"], ["state_action_value"])
        >>> loss = QWeightedLoss(None, actor, qvalue, weighting="exponential", num_candidates=4)
        >>> flag = torch.zeros(8, 1, dtype=torch.bool)
        >>> following = {"observation": torch.randn(8, 3), "reward": torch.ones(8, 1), "done": flag, "terminated": flag}
        >>> data = {"observation": torch.randn(8, 3), "action": torch.zeros(8, 1), "next": following}
        >>> bool(loss(TensorDict(data, [8]))["candidate_gap"] >= 0)
        True
    """

    out_keys: ClassVar[list[NestedKey]] = [*DiffusionActorCriticLoss.out_keys, "candidate_gap"]

    def __init__(
        self,
        encoder: TensorDictModule | None,
        actor: TensorDictModule,
        qvalue: TensorDictModule,
        *,
        weighting: str = "advantage",
        num_candidates: int = 16,
        temperature: float = 1.0,
        entropy_weight: float = 0.02,
        **options,
    ) -> None:
        if weighting not in WEIGHTINGS:
            raise ValueError(f"weighting: got {weighting!r}, allowed are {', '.join(WEIGHTINGS)}")
        if num_candidates < 2:
            raise ValueError(f"num_candidates: got {num_candidates}, must be at least 2")
        if not temperature > 0:
            raise ValueError(f"temperature: got {temperature}, must be greater than 0")
        if not entropy_weight >= 0:
            raise ValueError(f"entropy_weight: got {entropy_weight}, must be at least 0")
        super().__init__(encoder, actor, qvalue, **options)
        self.weighting, self.num_candidates = weighting, num_candidates
        self.temperature, self.entropy_weight = temperature, entropy_weight

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Weighted diffusion loss (Eq. 1 with weights), and what to log of it."""
        keys = self.tensor_keys
        self._require(tensordict, self._present_keys)
        embedding = self._embed(tensordict, "encoder_network")
        candidates, value = self._candidates(tensordict, embedding)
        spread = value - value.mean(0)
        if self.weighting == "advantage":
            best = value.argmax(0, keepdim=True)
            candidates = candidates.gather(0, best.expand(1, *candidates.shape[1:]))
            weight = spread.amax(0, keepdim=True)
            weight = weight / weight.mean().clamp_min(torch.finfo(weight.dtype).eps)
        else:
            scale = spread.square().mean().sqrt().clamp_min(torch.finfo(spread.dtype).eps)
            weight = (spread / (self.temperature * scale)).softmax(0)
        demonstration = tensordict.get(keys.demonstration, None)
        if demonstration is not None:
            demonstration = demonstration.reshape(*tensordict.shape, *[1] * (weight.ndim - 1 - tensordict.ndim))
            candidates = candidates.where(~demonstration, tensordict[keys.action])
            weight = weight.where(~demonstration, 1 / len(weight))
        error = (weight * self._error_of_many(embedding, candidates)).sum(0)
        if self.weighting == "advantage" and self.entropy_weight > 0:
            low, high = self.actor_network.module.low, self.actor_network.module.high
            uniform = low + (high - low) * torch.rand_like(candidates)
            error = error + self.entropy_weight * self._error_of_many(embedding, uniform).sum(0)
        weights = self._maybe_get_priority_weight(tensordict)
        loss = self._reduce(error, tensordict, weights, tensordict.get(keys.actor_mask, None))
        return loss, {"candidate_gap": spread.amax(0).mean()}

    @torch.no_grad()
    def _candidates(self, tensordict: TensorDictBase, embedding: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Actions drawn from the actor, ``[N, *B, n, A]``, and their values, ``[N, *B, n, 1]``."""
        many = (self.num_candidates, *tensordict.shape)
        actions = self._sample_action(embedding.expand(many), self.actor_network_params)
        critic_view = self._critic_embedding(tensordict) if self.separate_encoders else embedding
        return actions, self._qvalues(critic_view.expand(many), actions, self.qvalue_network_params).amin(0)

    def _error_of_many(self, embedding: TensorDictBase, action: Tensor) -> Tensor:
        return self._denoising_error(embedding.expand(len(action), *embedding.shape), action)
