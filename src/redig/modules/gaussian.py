"""Actors without diffusion, to compare with: one Gaussian, or one action, for each embedding."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict.nn import TensorDictModule
from tensordict.utils import NestedKey
from torch import Tensor, nn
from torchrl.data import Composite, TensorSpec
from torchrl.envs.utils import ExplorationType, exploration_type

from redig.modules.bounded import BoundedPolicy, action_bounds

LOG_STD = (-5.0, 1.0)  # of actions scaled to [-1, 1]


class GaussianPolicy(BoundedPolicy):
    """Tensors in, tensors out; :class:`GaussianActor` gives it its keys.

    Args:
        net: from the embedding ``[*B, H]`` to the mean, or the mean and the log of the standard deviation, of the
            action scaled to [-1, 1]: ``[*B, A]`` or ``[*B, 2 A]``.
        low, high: bounds of the action ``[A]``.
        stochastic: whether ``net`` gives a standard deviation.

    Examples:
        >>> import torch
        >>> policy = GaussianPolicy(nn.Linear(8, 2), -torch.ones(2), torch.ones(2), stochastic=False)
        >>> policy(torch.randn(5, 8)).shape
        torch.Size([5, 2])
    """

    def __init__(self, net: nn.Module, low: Tensor, high: Tensor, stochastic: bool = True) -> None:
        super().__init__(low, high)
        self.net, self.stochastic = net, stochastic

    def distribution(self, *embedding: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log of the standard deviation of the scaled action, ``[*B, A]`` both."""
        parameters = self.net(torch.cat(embedding, -1)).to(torch.promote_types(self.low.dtype, torch.float32))
        if not self.stochastic:
            return parameters, torch.zeros_like(parameters)
        mean, log_std = parameters.chunk(2, -1)
        return mean, log_std.clamp(*LOG_STD)

    def forward(self, *embedding: Tensor) -> Tensor:
        """Actions ``[*B, A]`` within the bounds for embeddings ``[*B, H]``."""
        action, log_std = self.distribution(*embedding)
        if self.stochastic and exploration_type() in (ExplorationType.RANDOM, None):
            action = action + log_std.exp() * torch.randn_like(action)
        return self.denormalize(action)

    def action_loss(self, action: Tensor, *embedding: Tensor) -> Tensor:
        """Negative log likelihood of actions ``[*B, A]``, up to a constant, or half the squared error: ``[*B]``.

        Raises:
            ValueError: if the shapes do not fit each other.
        """
        self.check_action(action, *embedding)
        mean, log_std = self.distribution(*embedding)
        return (0.5 * ((self.normalize(action) - mean) / log_std.exp()).square() + log_std).mean(-1)


class GaussianActor(TensorDictModule):
    """A Gaussian or deterministic policy with the interface of :class:`~redig.modules.DiffusionActor`.

    The losses train it as they train a diffusion policy, so that what diffusion brings can be told apart: give it to
    :class:`~redig.objectives.DIPOLoss` in its place. With ``ExplorationType.RANDOM`` (or none set) it samples,
    otherwise it gives the mean.

    Args:
        net: from the embeddings ``[*B, H]`` (several are concatenated) to ``[*B, 2 A]``, or ``[*B, A]`` where it is
            not stochastic, such as :func:`~redig.modules.denoiser.mlp`.
        action_spec: bounded spec of the action, see :class:`~redig.modules.DiffusionActor`.
        in_keys: keys of the embeddings.
        out_keys: key of the action.
        stochastic: a Gaussian, trained by its likelihood; otherwise one action, trained by its squared error.

    Raises:
        KeyError: if the spec lacks the action's key.
        ValueError: if there is not one action key, or the spec has no finite bounds.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules.denoiser import mlp
        >>> actor = GaussianActor(mlp(64, (128,), 4), Bounded(-1, 1, (5, 2)), ["embedding"], ["action"])
        >>> actor(TensorDict({"embedding": torch.randn(8, 5, 64)}, [8]))["action"].shape
        torch.Size([8, 5, 2])
    """

    module: GaussianPolicy

    def __init__(
        self,
        net: nn.Module,
        action_spec: TensorSpec,
        in_keys: Sequence[NestedKey] = (("agents", "embedding"),),
        out_keys: Sequence[NestedKey] = (("agents", "action"),),
        stochastic: bool = True,
    ) -> None:
        if len(out_keys) != 1:
            raise ValueError(f"out_keys: got {list(out_keys)}, must be one key, the action's")
        low, high, action_shape = action_bounds(action_spec, out_keys[0])
        super().__init__(GaussianPolicy(net, low, high, stochastic), in_keys=list(in_keys), out_keys=list(out_keys))
        self.action_shape = action_shape

    @property
    def spec(self) -> Composite:
        """Spec of the action of one environment, on the actor's device."""
        return self.module.spec(self.out_keys[0], self.action_shape)
