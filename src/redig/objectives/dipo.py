"""The DIPO loss: twin critics whose gradient refines actions, and a diffusion policy that learns the refined ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor

from redig.objectives.actor_critic import DiffusionActorCriticLoss
from redig.objectives.refinement import check_refinement, refine_actions

REFINE_FROM = ("stored", "policy")


class DIPOLoss(DiffusionActorCriticLoss):
    """Diffusion policy improvement (Yang et al., 2023) on graph embeddings: lines 9 to 13 of Algorithm 1.

    * ``loss_qvalue`` (Eq. 2): TD error of the twin critics, see
      :class:`~redig.objectives.DiffusionActorCriticLoss`, which also explains the arguments not listed here.
    * refinement (Sec. 3.2.2): ``a <- a + eta grad_a min(Q1, Q2)(h, a)``, ``refine_steps`` times.
    * ``loss_actor`` (Eq. 1): diffusion loss of the actor on the refined actions.

    Where the optional flag ``demonstration`` is true, actions are imitated as they are, not refined. It is the anchor
    that keeps online training from destroying a cloned policy.

    DIPO as its authors run it: ``refine_steps=20, refine_optimizer="adam", refine_step_size=0.03,
    refine_grad_norm=0.1 * A``, and improved actions kept in the buffer. For the last, store a copy of each action as
    ``"best_action"``, set ``base_action`` and ``refined_action`` to that key, and write it back after each actor loss:
    ``buffer.set_at_("best_action", batch["best_action"], batch["index"])`` on a storage of TensorDicts.

    Args:
        encoder, actor, qvalue: see :class:`~redig.objectives.DiffusionActorCriticLoss`.

    Keyword Args:
        refine_steps: number of gradient steps on the action; 0 turns refinement off (behaviour cloning).
        refine_step_size: eta. This and the next two are for actions scaled to [-1, 1], that is in half ranges of the
            action (with bounds of -1 and 1 m/s: in m/s).
        refine_max_norm: limit on the distance between the refined and the original action.
        refine_grad_norm: limit on the norm of the gradient of the whole batch.
        refine_optimizer: ``"sgd"``, the paper's plain step, or ``"adam"``.
        refine_from: ``"stored"`` refines the action of the batch (key ``base_action``), as DIPO does; ``"policy"``
            refines actions freshly sampled from the actor, as Algorithm 1 reads.
        **options: see :class:`~redig.objectives.DiffusionActorCriticLoss`.

    Forward writes ``td_error`` and ``refined_action`` into its input and returns ``loss_qvalue``, ``loss_actor``,
    ``pred_value``, ``target_value``, ``next_state_value`` and ``refine_distance`` (mean distance that actions moved).

    Raises:
        ValueError: for arguments outside their range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor, GraphEncoder, QNetwork
        >>> encoder = TensorDictModule(GraphEncoder(9), in_keys=["observation"], out_keys=["embedding"])
        >>> spec = Bounded(-1, 1, (5, 2))
        >>> actor = DiffusionActor(DenoisingMLP(2, 64), spec, in_keys=["embedding"], out_keys=["action"])
        >>> qvalue = TensorDictModule(QNetwork(64, 2), in_keys=["embedding", "action"], out_keys=["state_action_value"])
        >>> loss = DIPOLoss(encoder, actor, qvalue, refine_steps=1)
        >>> flag = torch.zeros(8, 5, 1, dtype=torch.bool)
        >>> following = {"reward": torch.ones(8, 5, 1), "done": flag, "terminated": flag}
        >>> following["observation"] = torch.randn(8, 5, 9)
        >>> data = {"observation": torch.randn(8, 5, 9), "action": torch.zeros(8, 5, 2), "next": following}
        >>> data = TensorDict(data, [8])
        >>> sorted(key for key in loss(data).keys() if key.startswith("loss"))
        ['loss_actor', 'loss_qvalue']
    """

    @dataclass
    class _AcceptedKeys(DiffusionActorCriticLoss._AcceptedKeys):
        """Keys that ``set_keys`` can rename, beside the common ones; all may be nested.

        Attributes:
            base_action: the action to refine (default: ``action``); set it to where the collector keeps the policy's
                action without exploration noise, or to where improved actions are kept.
            refined_action: where the refined action is written.
        """

        base_action: NestedKey | None = None
        refined_action: NestedKey = "refined_action"

    tensor_keys: _AcceptedKeys
    default_keys = _AcceptedKeys
    out_keys: ClassVar[list[NestedKey]] = [*DiffusionActorCriticLoss.out_keys, "refine_distance"]

    def __init__(
        self,
        encoder: TensorDictModule | None,
        actor: TensorDictModule,
        qvalue: TensorDictModule,
        *,
        refine_steps: int = 1,
        refine_step_size: float = 0.3,
        refine_max_norm: float | None = None,
        refine_grad_norm: float | None = None,
        refine_optimizer: str = "sgd",
        refine_from: str = "stored",
        **options,
    ) -> None:
        if refine_from not in REFINE_FROM:
            raise ValueError(f"refine_from: got {refine_from!r}, allowed are {', '.join(REFINE_FROM)}")
        refinement: dict[str, Any] = {
            "steps": refine_steps,
            "step_size": refine_step_size,
            "max_norm": refine_max_norm,
            "grad_norm": refine_grad_norm,
            "optimizer": refine_optimizer,
        }
        check_refinement(**refinement, prefix="refine_")
        super().__init__(encoder, actor, qvalue, **options)
        self.refinement, self.refine_from = refinement, refine_from

    def actor_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Diffusion loss on refined actions (Eq. 1), and what to log of it."""
        self._check(tensordict, self._actor_keys)
        embedding = self._embed(tensordict, "encoder_network")
        distance = self._write_refined(tensordict, embedding)
        return self._loss_on_refined(tensordict, embedding), {"refine_distance": distance}

    def write_refined(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the refined actions of a batch into it, under ``refined_action``, for :meth:`diffusion_loss`.

        The two together are :meth:`actor_loss`. Refinement needs no gradient of the networks' parameters, so the
        actions of several updates can be refined at once; they then share one state of the critics.
        """
        self._check(tensordict, self._actor_keys)
        self._write_refined(tensordict)
        return tensordict

    def diffusion_loss(self, tensordict: TensorDictBase) -> tuple[Tensor, dict[str, Tensor]]:
        """Diffusion loss (Eq. 1) on the actions that :meth:`write_refined` left in the batch; nothing to log."""
        self._check(tensordict, [*self._present_keys, self.tensor_keys.refined_action])
        return self._loss_on_refined(tensordict, self._embed(tensordict, "encoder_network")), {}

    @property
    def _actor_keys(self) -> list[NestedKey]:
        """The keys that refinement and the diffusion loss read."""
        keys = self.tensor_keys
        return [*self._present_keys, *([keys.base_action or keys.action] if self.refine_from == "stored" else [])]

    @torch.no_grad()
    def _write_refined(self, tensordict: TensorDictBase, embedding: TensorDictBase | None = None) -> Tensor:
        """Refine the actions of a batch, given the actor's embedding if it is there; the mean distance they moved."""
        keys = self.tensor_keys
        critic_view = self._critic_embedding(tensordict)
        executed = self._action(tensordict, keys.action, critic_view)
        if self.refine_from == "policy":
            embedding = self._embed(tensordict, "encoder_network") if embedding is None else embedding
            base = self._sample_action(embedding, self.actor_network_params)
        else:
            base = self._action(tensordict, keys.base_action or keys.action, critic_view)
        refined = self._refine(critic_view, base)
        demonstration = self._flag(tensordict, keys.demonstration, refined[..., :1])
        if demonstration is not None:
            refined, base = executed.where(demonstration, refined), executed.where(demonstration, base)
        tensordict[keys.refined_action] = refined
        return (refined - base).norm(dim=-1).mean()

    def _loss_on_refined(self, tensordict: TensorDictBase, embedding: TensorDictBase) -> Tensor:
        keys = self.tensor_keys
        error = self._action_loss(embedding, tensordict[keys.refined_action])
        counted = self._counted(tensordict, error, self._flag(tensordict, keys.actor_mask, error))
        return self._reduce(error, tensordict, counted)

    def refine(self, tensordict: TensorDictBase, action: Tensor) -> Tensor:
        """Improve actions along the critics' gradient, ``a + eta grad_a min(Q1, Q2)``.

        Args:
            tensordict: batch with the observations.
            action: ``[*B, n, A]``.

        Returns:
            refined action ``[*B, n, A]`` within the bounds of the actor, detached.
        """
        with torch.no_grad():
            embedding = self._critic_embedding(tensordict)
        return self._refine(embedding, action)

    def _refine(self, embedding: TensorDictBase, action: Tensor) -> Tensor:
        if self.refinement["steps"] == 0:
            return action.detach()
        params = self.qvalue_network_params.detach()
        low, high = self._bounds
        return refine_actions(
            action, lambda candidate: self._qvalues(embedding, candidate, params).amin(0), low, high, **self.refinement
        )
