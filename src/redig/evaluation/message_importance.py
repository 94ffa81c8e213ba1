"""Whose messages move a robot: how far its command depends on where each teammate says that it is (Fig. 6)."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor


@torch.enable_grad()
def message_importance(act: Callable[[Tensor], Tensor], position: Tensor) -> Tensor:
    """Importance of every message, ``I_ij = |d a_i / d p_j|_F``: m/s of robot i's command for a metre of robot j.

    The derivative is total: ``act`` goes from positions through all observations (place, goal seen from there, distance
    to the nearest obstacle), the encoder and the whole denoising chain. What robot j sees reaches another robot only as
    a message, so ``I_ij`` is what that message does to the command, 0 out of range and 0 if i ignores what j says.

    The paper takes the norm of the message instead (:meth:`redig.modules.GraphEncoder.message_norms`). That norm counts
    what the aggregation throws away, what later layers ignore, and the part of a message that is robot i's own state or
    a bias, so it is not small where nothing is heard.

    Args:
        act: from positions ``[*B, n, 2]`` (m) to commands ``[*B, n, A]`` (m/s), without randomness; teams must not
            depend on each other.
        position: where to ask, ``[*B, n, 2]`` (m).

    Returns:
        ``[*B, n, n]`` (1/s), row i hears column j; the diagonal is what a robot's own place means to it.

    Raises:
        ValueError: if ``position`` or the commands have another shape.

    Examples:
        >>> import torch
        >>> pair = torch.tensor([[0.0, 0.0], [2.0, 0.0]])
        >>> follow = lambda p: torch.stack([torch.zeros(2), 3 * (p[0] - p[1])])  # robot 1 follows robot 0
        >>> message_importance(follow, pair)
        tensor([[0.0000, 0.0000],
                [4.2426, 4.2426]])
    """
    if position.ndim < 2 or position.shape[-1] != 2:
        raise ValueError(f"position: got shape {list(position.shape)}, expected [*B, n, 2]")
    place = position.detach().clone().requires_grad_()
    command = act(place)
    if command.ndim != place.ndim or command.shape[:-1] != place.shape[:-1]:
        expected = f"[{', '.join(map(str, place.shape[:-1]))}, A]"
        raise ValueError(f"act: it returned shape {list(command.shape)}, expected {expected}")
    rows = [_squared_norms(command[..., i, :], place) for i in range(place.shape[-2])]
    return torch.stack(rows, -2).sqrt()


def _squared_norms(command: Tensor, place: Tensor) -> Tensor:
    """``[*B, n]``: squared norm of the derivative of one robot's command ``[*B, A]`` by the place of each."""
    if not command.requires_grad:
        return torch.zeros_like(place[..., 0])
    total = torch.zeros_like(place[..., 0])
    for component in command.unbind(-1):
        # teams do not depend on each other, so the gradient of the sum holds that of each team
        (gradient,) = torch.autograd.grad(component.sum(), place, retain_graph=True, materialize_grads=True)
        total += gradient.square().sum(-1)
    return total
