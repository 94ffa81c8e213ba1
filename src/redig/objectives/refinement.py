"""Action refinement: a few steps along the critics' gradient (Sec. 3.2.2)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


def refine_actions(
    action: Tensor,
    value: Callable[[Tensor], Tensor],
    low: Tensor,
    high: Tensor,
    steps: int = 1,
    step_size: float = 0.3,
    max_norm: float | None = None,
) -> Tensor:
    """``a <- a + eta grad_a Q(h, a)``, kept within the bounds and, if wanted, near the original action.

    Args:
        action: ``[*B, A]``.
        value: Q of candidate actions, ``[*B, A]`` to any shape with one number an action.
        low: lower bounds ``[A]``.
        high: upper bounds ``[A]``.
        steps: number of gradient steps.
        step_size: eta, in the units of the action a unit of gradient.
        max_norm: limit on the distance from the original action (units of the action).

    Returns:
        refined actions ``[*B, A]``, detached.

    Examples:
        >>> import torch
        >>> bowl = lambda a: -(a - 0.5).square().sum(-1)
        >>> one = torch.ones(1)
        >>> refine_actions(torch.zeros(3, 1), bowl, -one, one, steps=20, step_size=0.25).squeeze(-1)
        tensor([0.5000, 0.5000, 0.5000])
    """
    gradient = torch.func.grad(lambda candidate: value(candidate).sum())
    action = action.detach()
    refined = action
    for _ in range(steps):
        refined = refined + step_size * gradient(refined)
        if max_norm is not None:
            shift = refined - action
            norm = shift.norm(dim=-1, keepdim=True)
            refined = action + shift * (max_norm / norm.clamp_min(max_norm))
        refined = refined.maximum(low).minimum(high)
    return refined.detach()
