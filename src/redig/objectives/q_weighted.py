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

    For each state ``num_candidates`` actions are drawn from the actor and valued by ``Q = min(Q1, Q2)``; ``A`` is ``Q``
    minus its mean over the candidates. Then

    * ``"advantage"`` (QVPO, Ding et al., 2024): the best candidate is learned with weight ``A``, divided by its mean
      over the batch. So are actions drawn uniformly from the bounds, one a state, with ``entropy_weight`` times this
      weight; they keep the policy exploring. The authors draw ten with 0.02 each, falling to 0.002 during training: in
      the mean 0.2 to 0.02 here. They do not divide by the mean, and take the best of 4 candidates when they act.
    * ``"exponential"`` (DPMD, Ma et al., 2025): all candidates are learned, with weights ``softmax(A / temperature)``:
      a step of policy mirror descent, ``pi_new ~ pi_old exp(Q / temperature)`` for many candidates. ``A`` is divided by
      its root mean square over candidates and batch, so the temperature has no units. The authors weight one sample a
      state by ``exp(Q / temperature)``, with ``Q`` standardised over batches.

    Robots that do not count (``actor_mask``) and demonstrations are left out of these means. Critics, encoders and keys
    are those of :class:`~redig.objectives.DIPOLoss`. Where the optional flag ``demonstration`` is true, actions are
    imitated as they are, with weight 1.

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
        self._check(tensordict, self._present_keys)
        embedding = self._embed(tensordict, "encoder_network")
        executed = self._action(tensordict, keys.action, embedding)
        candidates, value = self._candidates(tensordict, embedding)
        advantage, like = value - value.mean(0), value[0]
        counted = self._counted(tensordict, like, self._flag(tensordict, keys.actor_mask, like))
        demonstration = self._flag(tensordict, keys.demonstration, like)
        if demonstration is None:
            demonstration = torch.zeros_like(like, dtype=torch.bool)
        candidates, weight = self._weigh(candidates, advantage, counted & ~demonstration)
        candidates = executed.where(demonstration, candidates)
        error = (weight.where(~demonstration, 1 / len(weight)) * self._error_of_many(embedding, candidates)).sum(0)
        if self.weighting == "advantage" and self.entropy_weight > 0:
            own = self.entropy_weight * weight[0].where(~demonstration, 0)
            error = error + own * self._action_loss(embedding, self._uniform(executed))
        return self._reduce(error, tensordict, counted), {"candidate_gap": advantage.amax(0).mean()}

    def _weigh(self, candidates: Tensor, advantage: Tensor, counted: Tensor) -> tuple[Tensor, Tensor]:
        """Actions to learn, ``[N, *B, n, A]``, and their weights, ``[N, *B, n, 1]``; N is 1 with ``"advantage"``."""
        total, tiny = counted.sum().clamp_min(1), torch.finfo(advantage.dtype).eps
        if self.weighting == "advantage":
            weight, best = advantage.max(0, keepdim=True)
            mean = weight.where(counted, 0).sum() / total
            return candidates.gather(0, best.expand(1, *candidates.shape[1:])), weight / mean.clamp_min(tiny)
        square = advantage.square().mean(0).where(counted, 0).sum() / total
        return candidates, (advantage / (self.temperature * square.sqrt().clamp_min(tiny))).softmax(0)

    @torch.no_grad()
    def _candidates(self, tensordict: TensorDictBase, embedding: TensorDictBase) -> tuple[Tensor, Tensor]:
        """Actions drawn from the actor, ``[N, *B, n, A]``, and their values, ``[N, *B, n, 1]``."""
        many = (self.num_candidates, *tensordict.shape)
        states = embedding.expand(many)
        latent = getattr(self.actor_network, "latent_key", None)
        if latent is not None:  # the one of the batch would give the same action many times
            states[latent] = torch.empty_like(states[latent]).normal_(generator=self._generator)
        actions = self._sample_action(states, self.actor_network_params)
        critic_view = self._critic_embedding(tensordict) if self.separate_encoders else embedding
        return actions, self._qvalues(critic_view.expand(many), actions, self.qvalue_network_params).amin(0)

    def _error_of_many(self, embedding: TensorDictBase, action: Tensor) -> Tensor:
        return self._action_loss(embedding.expand(len(action), *embedding.shape), action)

    def _uniform(self, action: Tensor) -> Tensor:
        low, high = self._bounds
        return low + (high - low) * torch.empty_like(action).uniform_(generator=self._generator)

    @property
    def _generator(self) -> torch.Generator | None:
        """The actor's source of randomness."""
        return getattr(self.actor_network.module, "generator", None)
