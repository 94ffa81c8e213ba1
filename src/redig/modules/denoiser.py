"""The denoising network: which noise is in this action, given the step and the team embedding."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import cast

import torch
from torch import Tensor, nn

ACTIVATIONS: dict[str, type[nn.Module]] = {"mish": nn.Mish, "relu": nn.ReLU, "silu": nn.SiLU, "tanh": nn.Tanh}


def mlp(
    in_features: int, hidden: Sequence[int], out_features: int, activation: str = "mish", layer_norm: bool = False
) -> nn.Sequential:
    """Multi-layer perceptron, optionally with LayerNorm after each hidden linear layer.

    Raises:
        ValueError: for an unknown activation.

    Examples:
        >>> mlp(3, (8,), 1, "relu")
        Sequential(
          (0): Linear(in_features=3, out_features=8, bias=True)
          (1): ReLU()
          (2): Linear(in_features=8, out_features=1, bias=True)
        )
    """
    if activation not in ACTIVATIONS:
        raise ValueError(f"activation: got {activation!r}, allowed are {', '.join(ACTIVATIONS)}")
    layers: list[nn.Module] = []
    for width in hidden:
        layers.append(nn.Linear(in_features, width))
        if layer_norm:
            layers.append(nn.LayerNorm(width))
        layers.append(ACTIVATIONS[activation]())
        in_features = width
    return nn.Sequential(*layers, nn.Linear(in_features, out_features))


def weight_dtype(net: nn.Sequential) -> torch.dtype:
    """Type of the first layer's weight, also where ``parameters()`` is empty because TorchRL made them functional.

    Examples:
        >>> weight_dtype(mlp(3, (8,), 1).double())
        torch.float64
    """
    return cast(Tensor, net[0].weight).dtype


def sinusoidal_embedding(step: Tensor, dim: int, max_period: float = 10_000.0) -> Tensor:
    """Sinusoidal embedding of the diffusion step (Vaswani et al., 2017): ``[*B]`` to ``[*B, dim]``.

    Examples:
        >>> import torch
        >>> sinusoidal_embedding(torch.tensor([0.0]), 4)
        tensor([[0., 0., 1., 1.]])
    """
    half = dim // 2
    frequency = torch.exp(-math.log(max_period) * torch.arange(half, device=step.device) / max(half - 1, 1))
    angle = step.unsqueeze(-1) * frequency
    return torch.cat([angle.sin(), angle.cos()], -1)


def quick_mish_(x: Tensor) -> Tensor:
    """Mish in place with one exponential, ``x n / (n + 1)`` with ``n = e^x + e^2x / 2``; not for gradients.

    Examples:
        >>> import torch
        >>> x = torch.linspace(-50, 50, 101)
        >>> torch.allclose(quick_mish_(x.clone()), nn.functional.mish(x), atol=1e-6)
        True
    """
    e = x.clamp(max=20).exp_()  # e^40 does not overflow, and beyond 20 Mish is x
    n = torch.addcmul(e, e, e, value=0.5)
    return x.mul_(n).div_(torch.add(n, 1, out=e))


def quick_mish_pays(x: Tensor) -> bool:
    """Whether :func:`quick_mish_` is faster than PyTorch's, which takes three functions a number but one call.

    Measured on a CPU in float32: 2.5 times for what fits into a cache, not for a few numbers nor for millions.

    Examples:
        >>> import torch
        >>> [quick_mish_pays(torch.zeros(robots, 128)) for robots in (5, 260, 20_480)]
        [False, False, False]
        >>> with torch.no_grad():
        ...     [quick_mish_pays(torch.zeros(robots, 128)) for robots in (5, 260, 20_480)]
        [False, True, False]
    """
    return eager_on_cpu(x) and 2**13 <= x.numel() <= 2**19


def rows_at_once(x: Tensor, width: int) -> int | None:
    """How many rows of a large batch to take through a network at a time, to stay in a cache; None: all of them.

    Measured on a CPU in float32: a chain of a million numbers takes half the time in pieces.

    Args:
        x: ``[*B, W]``, a row for each of ``*B``.
        width: how many numbers the network has in the middle for each row.

    Examples:
        >>> import torch
        >>> with torch.no_grad():
        ...     [rows_at_once(torch.zeros(robots, 2), width=128) for robots in (5, 20_480)]
        [None, 2048]
    """
    if not eager_on_cpu(x):  # nor may an export or a compiler see the sizes below
        return None
    return 2**18 // width if x.shape[:-1].numel() * width > 2**19 and width <= 2**18 else None


def eager_on_cpu(x: Tensor) -> bool:
    """Whether each function of ``x`` is a pass over memory of its own: float32 on a CPU, not compiled, no gradients.

    Examples:
        >>> import torch
        >>> x = torch.zeros(5, 128)
        >>> eager_on_cpu(x), torch.no_grad()(eager_on_cpu)(x)
        (False, True)
    """
    if torch.is_grad_enabled() or torch.compiler.is_compiling() or torch.compiler.is_exporting():
        return False
    return x.device.type == "cpu" and x.dtype == torch.float32


def check_shapes(action: Tensor, action_dim: int, embedding: Tensor, embedding_dim: int) -> None:
    """Check that actions ``[*B, A]`` and embeddings ``[*B, H]`` fit each other and a network built for A and H.

    Raises:
        ValueError: if they do not; it names the shapes seen and expected.

    Examples:
        >>> import torch
        >>> check_shapes(torch.zeros(8, 5, 2), 2, torch.zeros(8, 4, 64), 64)
        Traceback (most recent call last):
        ...
        ValueError: embedding: got shape [8, 4, 64], expected [8, 5, 64] to go with the action's shape [8, 5, 2]
    """
    if action.shape[-1:] != (action_dim,):
        raise ValueError(f"action: got shape {list(action.shape)}, expected [*B, {action_dim}]")
    expected = [*action.shape[:-1], embedding_dim]
    if list(embedding.shape) != expected:
        raise ValueError(
            f"embedding: got shape {list(embedding.shape)}, expected {expected} to go with the action's shape "
            f"{list(action.shape)}"
        )


class DenoisingMLP(nn.Module):
    """eps_theta(a^k, k | h): Mish perceptron on the noisy action, the embedded step and the team embedding.

    Args:
        action_dim: A.
        embedding_dim: width of the embedding h.
        hidden: widths of the hidden layers (the paper: 3 of 256).
        step_dim: width of the sinusoidal embedding of the step.
        activation: ``"mish"`` (the paper), ``"relu"``, ``"silu"`` or ``"tanh"``.

    Examples:
        >>> import torch
        >>> denoiser = DenoisingMLP(action_dim=2, embedding_dim=64)
        >>> denoiser(torch.zeros(8, 5, 2), torch.zeros(8, 5), torch.zeros(8, 5, 64)).shape
        torch.Size([8, 5, 2])
    """

    def __init__(
        self,
        action_dim: int,
        embedding_dim: int,
        hidden: Sequence[int] = (256, 256, 256),
        step_dim: int = 16,
        activation: str = "mish",
    ) -> None:
        super().__init__()
        if step_dim < 2 or step_dim % 2:
            raise ValueError(f"step_dim: got {step_dim}, must be even and at least 2")
        self.action_dim, self.embedding_dim = action_dim, embedding_dim
        self.step_dim = step_dim
        self.net = mlp(action_dim + step_dim + embedding_dim, hidden, action_dim, activation)

    def forward(self, action: Tensor, step: Tensor, embedding: Tensor) -> Tensor:
        """Predict the noise. All inputs are cast to the network's type.

        Args:
            action: noisy action ``[*B, A]``.
            step: ``[*B]`` or a scalar tensor, counted from 0.
            embedding: ``[*B, H]``.

        Returns:
            noise ``[*B, A]``.

        Raises:
            ValueError: if the shapes do not fit each other or the network.
        """
        check_shapes(action, self.action_dim, embedding, self.embedding_dim)
        if step.ndim > 0 and step.shape != action.shape[:-1]:
            expected = f"{list(action.shape[:-1])}, one for each action, or a scalar"
            raise ValueError(f"step: got shape {list(step.shape)}, expected {expected}")
        dtype = weight_dtype(self.net)
        time = sinusoidal_embedding(step.float(), self.step_dim).to(dtype)  # half types would merge high steps
        time = time.expand(*action.shape[:-1], self.step_dim)
        return self.net(torch.cat([action.to(dtype), time, embedding.to(dtype)], -1))

    def prepare(self, embedding: Tensor, steps: Sequence[int]) -> Callable[[Tensor, int], Tensor]:
        """The network for a whole chain: what the first layer makes of embedding and steps is computed once.

        Args:
            embedding: ``[*B, H]``.
            steps: the steps that will be asked for.

        Returns:
            a function of noisy actions ``[*B, A]`` and one of the steps, with the values of :meth:`forward` up to
            rounding.

        Raises:
            ValueError: if the embedding does not fit the network.

        Examples:
            >>> import torch
            >>> denoiser, embedding = DenoisingMLP(action_dim=2, embedding_dim=64), torch.randn(8, 5, 64)
            >>> denoise = denoiser.prepare(embedding, steps=[99, 49])
            >>> action = torch.randn(8, 5, 2)
            >>> torch.allclose(denoise(action, 49), denoiser(action, torch.tensor(49), embedding), atol=1e-6)
            True
        """
        action_shape = (*embedding.shape[:-1], self.action_dim)
        check_shapes(embedding.new_empty(action_shape), self.action_dim, embedding, self.embedding_dim)
        first, rest = cast(nn.Linear, self.net[0]), cast(list[Callable[[Tensor], Tensor]], list(self.net)[1:])
        dtype = weight_dtype(self.net)
        of_action, of_time, of_embedding = first.weight.split([self.action_dim, self.step_dim, self.embedding_dim], 1)
        every = torch.arange(max(steps) + 1, device=embedding.device)  # no copy from the host, for CUDA graphs
        shift = nn.functional.linear(sinusoidal_embedding(every.float(), self.step_dim).to(dtype), of_time)
        base = nn.functional.linear(embedding.to(dtype), of_embedding, first.bias)
        rows = rows_at_once(base, base.shape[-1])
        pieces = (base,) if rows is None else base.flatten(0, -2).split(rows)
        if quick_mish_pays(pieces[0]):
            rest = [quick_mish_ if isinstance(layer, nn.Mish) else layer for layer in rest]

        def denoise(action: Tensor, step: int) -> Tensor:
            actions = (action,) if rows is None else action.flatten(0, -2).split(rows)
            noise = []
            for some, share in zip(actions, pieces, strict=True):
                hidden = nn.functional.linear(some.to(dtype), of_action, shift[step]) + share
                for layer in rest:
                    hidden = layer(hidden)
                noise.append(hidden)
            return noise[0] if rows is None else torch.cat(noise).reshape(action.shape)

        return denoise
