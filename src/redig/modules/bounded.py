"""What all policies with bounded actions share: the bounds, and the scale from -1 to 1 in which they compute."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import torch
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Bounded, Composite, TensorSpec

from redig.modules.schedule import keep_precision

PolicyT = TypeVar("PolicyT", bound="BoundedPolicy")


class BoundedPolicy(nn.Module):
    """Tensors in, actions within bounds out. The bounds stay in float32, whatever the type of the network.

    A policy that the losses can train has, beside ``forward``, a method ``action_loss(action, *embedding)``: how badly
    it imitates given actions.

    Args:
        low, high: bounds of the action ``[A]``.

    Examples:
        >>> policy = BoundedPolicy(torch.zeros(2), torch.full((2,), 4.0))
        >>> policy.normalize(torch.tensor([0.0, 4.0])), policy.denormalize(torch.tensor([0.0, 7.0]))
        (tensor([-1.,  1.]), tensor([2., 4.]))
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low.clone())
        self.register_buffer("high", high.clone())

    def _apply(self: PolicyT, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> PolicyT:
        return keep_precision(self, super()._apply, fn, recurse)

    def normalize(self, action: Tensor) -> Tensor:
        """From the bounds to [-1, 1]."""
        return 2 * (action - self.low) / (self.high - self.low) - 1

    def denormalize(self, action: Tensor) -> Tensor:
        """From [-1, 1] to the bounds; what lies outside is clamped."""
        action = self.low + (action + 1) * (self.high - self.low) / 2
        return action.maximum(self.low).minimum(self.high)

    def spec(self, key: NestedKey, shape: torch.Size) -> Composite:
        """Spec of an action of ``shape`` ``[*n, A]`` under its key, on the policy's device."""
        low, high = self.low.expand(shape), self.high.expand(shape)
        return Composite({key: Bounded(low, high, shape, low.device, low.dtype)})

    def check_action(self, action: Tensor, *embedding: Tensor) -> None:
        """Check that given actions fit the bounds and the embeddings.

        Raises:
            ValueError: naming the shape seen and the one expected.
        """
        expected = (*embedding[0].shape[:-1], self.low.shape[-1])
        if action.shape != expected:
            raise ValueError(
                f"action: got shape {list(action.shape)}, expected {list(expected)} to go with the embedding's shape "
                f"{list(embedding[0].shape)}"
            )


def action_bounds(spec: TensorSpec, key: NestedKey) -> tuple[Tensor, Tensor, torch.Size]:
    """Bounds ``[A]`` and shape ``[*n, A]`` of the action of one environment.

    Args:
        spec: of the action, or the ``full_action_spec`` of an environment or of a batch of them.
        key: of the action in a ``full_action_spec``.

    Raises:
        KeyError: if the spec lacks the key.
        ValueError: if there are no finite bounds, or they differ between robots.

    Examples:
        >>> from torchrl.data import Bounded
        >>> action_bounds(Bounded(-1, 1, (5, 2)), "action")
        (tensor([-1., -1.]), tensor([1., 1.]), torch.Size([5, 2]))
    """
    batch_dims = 0
    if isinstance(spec, Composite):
        if key not in (there := spec.keys(True, True)):
            names = ", ".join(sorted(repr(k) for k in there)) or "none"
            raise KeyError(f"action_spec: no key {key!r}, the action's; it has {names}")
        batch_dims, spec = len(spec.shape), spec[key]
    space = getattr(spec, "space", None)
    low, high = getattr(space, "low", None), getattr(space, "high", None)
    if low is None or high is None or not torch.isfinite(high - low).all():
        raise ValueError(f"action_spec: got {type(spec).__name__} without finite bounds; use torchrl.data.Bounded")
    if spec.ndim == 0 or not (low < high).all():
        raise ValueError(f"action_spec: got shape {list(spec.shape)}, expected [*n, A] with low < high everywhere")
    low, high = low.reshape(-1, low.shape[-1]), high.reshape(-1, high.shape[-1])
    if not ((low == low[0]).all() and (high == high[0]).all()):
        raise ValueError("action_spec: the bounds differ between robots; use one actor for each kind of robot")
    return low[0], high[0], spec.shape[batch_dims:]
