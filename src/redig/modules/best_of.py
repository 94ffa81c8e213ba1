"""Best of N: draw several actions and take the one that the critics value most."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs.utils import ExplorationType, set_exploration_type


class BestOfN(TensorDictModuleBase):
    """The best of N actions of a policy by the critics, robot by robot (Wang et al., 2023; QVPO: N = 4 and 32).

    The policy's samples are random here whatever ``set_exploration_type`` says, for N equal ones would be no choice.
    Results with it are results of policy, critics and N, and must be reported as such.

    Args:
        policy: TensorDictModule that writes the action, such as encoder and :class:`~redig.modules.DiffusionActor`.
        value: values of the actions in a TensorDict, ``[*B, n, 1]`` or ``[*B, 1]``, such as
            ``value`` of :class:`~redig.objectives.DIPOLoss`, the minimum over the critics.
        num_candidates: N; 1 is the policy itself, sampled.
        action_key: key of the action.

    Raises:
        ValueError: if ``num_candidates`` is less than 1.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor
        >>> actor = DiffusionActor(DenoisingMLP(2, 8), Bounded(-1, 1, (2,)), ["embedding"], ["action"])
        >>> rightmost = BestOfN(actor, lambda data: data["action"][..., :1], 16, action_key="action")
        >>> rightmost(TensorDict({"embedding": torch.zeros(3, 8)}, [3]))["action"].shape
        torch.Size([3, 2])
    """

    def __init__(
        self,
        policy: TensorDictModuleBase,
        value: Callable[[TensorDictBase], Tensor],
        num_candidates: int,
        action_key: NestedKey = ("agents", "action"),
    ) -> None:
        if num_candidates < 1:
            raise ValueError(f"num_candidates: got {num_candidates}, must be at least 1")
        super().__init__()
        self.policy, self.num_candidates, self.action_key = policy, num_candidates, action_key
        self.in_keys, self.out_keys = list(policy.in_keys), [action_key]
        self._value = (
            value,
        )  # in a tuple: a bound method of a loss must not make its critics parameters of the policy

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the best action into ``tensordict``."""
        many = tensordict.expand(self.num_candidates, *tensordict.shape).clone(False)
        with torch.no_grad(), set_exploration_type(ExplorationType.RANDOM):
            many = self.policy(many)
            best = self._value[0](many).argmax(0, keepdim=True)  # [1, *B, n, 1]
        action = many[self.action_key]
        return tensordict.set(self.action_key, action.gather(0, best.expand(1, *action.shape[1:])).squeeze(0))
