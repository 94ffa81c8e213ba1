"""Reading a batch: required keys, shapes, types, and numbers of a team that count for each of its robots."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

HALF = (torch.float16, torch.bfloat16)


def under_next(key: NestedKey) -> NestedKey:
    """The key of the same thing one step later.

    Examples:
        >>> under_next(("agents", "reward"))
        ('next', 'agents', 'reward')
    """
    return ("next", key) if isinstance(key, str) else ("next", *key)


def require(batch: TensorDictBase, keys: Iterable[NestedKey]) -> None:
    """Check that a batch has all keys.

    Raises:
        KeyError: naming the keys that are missing and those that are there.

    Examples:
        >>> from tensordict import TensorDict
        >>> require(TensorDict({"observation": torch.zeros(2, 3)}, [2]), ["observation", ("next", "reward")])
        Traceback (most recent call last):
        ...
        KeyError: 'batch: no key next.reward (set_keys renames keys); it has observation'
    """
    there = batch.keys(True)
    missing = [dotted(key) for key in keys if key not in there]
    if missing:
        leaves = ", ".join(sorted(map(dotted, batch.keys(True, True))))
        raise KeyError(f"batch: no key {', '.join(missing)} (set_keys renames keys); it has {leaves}")


def dotted(key: NestedKey) -> str:
    """A key without quotes, which ``KeyError`` would escape.

    Examples:
        >>> dotted(("agents", "action"))
        'agents.action'
    """
    return key if isinstance(key, str) else ".".join(key)


def per_robot(key: NestedKey, value: Tensor, like: Tensor, batch: torch.Size) -> Tensor:
    """A team's number, ``[*B]`` or ``[*B, 1]``, for each of its robots; a robot's own is left as it is.

    Args:
        key: where the number was found.
        value: the number.
        like: values of the critic ``[*B, n, 1]``, or ``[*B, 1]`` without robots.
        batch: ``[*B]``.

    Returns:
        a tensor of the shape of ``like``.

    Raises:
        ValueError: naming the key, the shape seen and those allowed.

    Examples:
        >>> per_robot("reward", torch.tensor([[1.0], [2.0]]), torch.zeros(2, 3, 1), torch.Size([2])).squeeze(-1)
        tensor([[1., 1., 1.],
                [2., 2., 2.]])
    """
    if value.shape == like.shape:
        return value
    if value.shape in (batch, (*batch, 1)):
        return value.reshape(*batch, *[1] * (like.ndim - len(batch))).expand_as(like)
    raise ValueError(
        f"{key}: got shape {list(value.shape)}, expected {list(like.shape)}, one number for each value of the critic, "
        f"or {list(batch)} or {[*batch, 1]}, one for the whole team"
    )


def check_action(key: NestedKey, action: Tensor, low: Tensor, like: Tensor, like_key: NestedKey) -> None:
    """Check that actions ``[*B, n, A]`` fit the bounds ``[A]`` and what the actor reads, ``[*B, n, H]``.

    Raises:
        ValueError: naming the key, the shape seen and the one expected.

    Examples:
        >>> check_action("action", torch.zeros(8, 5, 2), torch.zeros(2), torch.zeros(8, 4, 64), "embedding")
        Traceback (most recent call last):
        ...
        ValueError: action: got shape [8, 5, 2], expected [8, 4, 2]: actions of width 2 for embedding [8, 4, 64]
    """
    expected = [*like.shape[:-1], low.shape[-1]]
    if list(action.shape) != expected:
        raise ValueError(
            f"{key}: got shape {list(action.shape)}, expected {expected}: actions of width {low.shape[-1]} for "
            f"{like_key} {list(like.shape)}"
        )


def at_least_float32(value: Tensor) -> Tensor:
    """Half types to float32: sums of rewards and means over a batch need its digits.

    Examples:
        >>> at_least_float32(torch.zeros(2, dtype=torch.bfloat16)).dtype
        torch.float32
    """
    return value.float() if value.dtype in HALF else value
