"""Action refinement: a few steps along the critics' gradient (Sec. 3.2.2)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

OPTIMIZERS = ("sgd", "adam")


def refine_actions(
    action: Tensor,
    value: Callable[[Tensor], Tensor],
    low: Tensor,
    high: Tensor,
    steps: int = 1,
    step_size: float = 0.3,
    max_norm: float | None = None,
    grad_norm: float | None = None,
    optimizer: str = "sgd",
) -> Tensor:
    """``a <- a + eta grad_a Q(h, a)``, kept within the bounds and, if wanted, near the original action.

    All of it happens with actions scaled from their bounds to [-1, 1], so that a step means the same in every action
    space; ``step_size``, ``max_norm`` and ``grad_norm`` are in these units.

    Args:
        action: ``[*B, A]``.
        value: Q of candidate actions, ``[*B, A]`` to any shape with one number an action.
        low: lower bounds ``[A]``.
        high: upper bounds ``[A]``.
        steps: number of gradient steps.
        step_size: eta; with ``"adam"`` its learning rate.
        max_norm: limit on the distance from the original action.
        grad_norm: limit on the norm of the gradient of the whole batch, as the DIPO authors have it.
        optimizer: ``"sgd"``, plain steps as in the paper, or ``"adam"`` (Kingma and Ba, 2015; epsilon 1e-5 as the DIPO
            authors have it), whose step does not depend on the size of the gradient.

    Returns:
        refined actions ``[*B, A]``, detached.

    Raises:
        ValueError: for arguments outside their range.

    Examples:
        >>> import torch
        >>> bowl = lambda a: -(a - 0.5).square().sum(-1)
        >>> one = torch.ones(1)
        >>> refine_actions(torch.zeros(3, 1), bowl, -one, one, steps=20, step_size=0.25).squeeze(-1)
        tensor([0.5000, 0.5000, 0.5000])
    """
    check_refinement(steps, step_size, max_norm, grad_norm, optimizer)
    middle, half = (high + low) / 2, (high - low) / 2
    gradient = torch.func.grad(lambda scaled: value(middle + half * scaled).sum())
    original = (action.detach() - middle) / half
    refined = original
    first, second = torch.zeros_like(refined), torch.zeros_like(refined)
    for step in range(1, steps + 1):
        ascent = gradient(refined)
        if grad_norm is not None:
            ascent = ascent * (grad_norm / ascent.norm().clamp_min(grad_norm))
        if optimizer == "adam":
            first = 0.9 * first + 0.1 * ascent
            second = 0.999 * second + 0.001 * ascent.square()
            ascent = first / (1 - 0.9**step) / ((second / (1 - 0.999**step)).sqrt() + 1e-5)
        refined = refined + step_size * ascent
        if max_norm is not None:
            shift = refined - original
            norm = shift.norm(dim=-1, keepdim=True)
            refined = original + shift * (max_norm / norm.clamp_min(max_norm))
        refined = refined.clamp(-1, 1)
    return (middle + half * refined).maximum(low).minimum(high).detach()


def check_refinement(
    steps: int,
    step_size: float,
    max_norm: float | None,
    grad_norm: float | None,
    optimizer: str,
    prefix: str = "",
) -> None:
    """Check the options of :func:`refine_actions`.

    Raises:
        ValueError: if one is outside its range; its name is preceded by ``prefix``.

    Examples:
        >>> check_refinement(-1, 0.3, None, None, "sgd", prefix="refine_")
        Traceback (most recent call last):
        ...
        ValueError: refine_steps: got -1, must be at least 0
    """
    if steps < 0:
        raise ValueError(f"{prefix}steps: got {steps}, must be at least 0")
    if not step_size >= 0:
        raise ValueError(f"{prefix}step_size: got {step_size}, must be at least 0")
    for name, limit in (("max_norm", max_norm), ("grad_norm", grad_norm)):
        if limit is not None and not limit > 0:
            raise ValueError(f"{prefix}{name}: got {limit}, must be greater than 0 or None")
    if optimizer not in OPTIMIZERS:
        raise ValueError(f"{prefix}optimizer: got {optimizer!r}, allowed are {', '.join(OPTIMIZERS)}")
