"""A clear error for an action that the simulator cannot take, where VMAS has a bare assertion."""

from __future__ import annotations

import torch
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.envs import Transform


class ActionCheck(Transform):
    """Environment transform that refuses actions which are not finite or outside the action spec.

    Args:
        action: key of the action.

    Raises:
        ValueError: at the step that is given such an action.

    Examples:
        >>> import torch
        >>> from redig.envs.factory import make_env
        >>> env = make_env(1)
        >>> data = env.reset()
        >>> data["agents", "action"] = torch.full((1, 5, 2), 9.0)
        >>> env.step(data)  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        ValueError: action ('agents', 'action'): 10 of 10 numbers are not finite or outside [-1.0, 1.0] (worst: 9.0)...
    """

    def __init__(self, action: NestedKey = ("agents", "action")) -> None:
        super().__init__(in_keys_inv=[action], out_keys_inv=[action])

    def _inv_apply_transform(self, action: Tensor) -> Tensor:
        space = self.parent.full_action_spec[self.in_keys_inv[0]].space
        excess = torch.maximum(action - space.high, space.low - action)  # NaN stays NaN
        bad = ~(excess <= 0)
        if bad.any():
            low, high = space.low.min().item(), space.high.max().item()
            worst = action.flatten()[excess.nan_to_num(nan=torch.inf).argmax()].item()
            raise ValueError(
                f"action {self.in_keys_inv[0]}: {int(bad.sum())} of {bad.numel()} numbers are not finite or outside "
                f"[{low}, {high}] (worst: {worst}); clamp the policy's output to env.action_spec"
            )
        return action
