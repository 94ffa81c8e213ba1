"""Theorem 2 as functions: what separates a learned critic from the value that it should learn.

``|Q - Q*| <= 2 gamma C S / (1 - gamma)^2 + 4 gamma^(M + 1) R_max / (1 - gamma)^2`` (Eq. 28), with the largest Bellman
residual S, the coverage C of the replay buffer and M iterations. What the paper leaves open: ``docs/theory.md``.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.envs.utils import set_exploration_type

from redig.objectives import DiffusionActorCriticLoss


@torch.no_grad()
def bellman_residual(loss: DiffusionActorCriticLoss, data: TensorDictBase) -> Tensor:
    """Bellman residual of every transition, ``|Q(h, a) - y|`` (Eq. 15), mean over the critics.

    The target networks play the previous iterate. ``.max()`` is the residual in the largest norm over this batch (for
    which ``C = 1``), ``.mean()`` the paper's L1 norm under the buffer (for which C is the coverage). The S of Eq. 16
    is the largest of either over all of training: keep the running maximum. A single draw of the next action stands in
    for an expectation, so noise of the policy counts as residual.

    Args:
        loss: :class:`~redig.objectives.DIPOLoss` or another with critics, its value estimator made.
        data: batch ``[*B]`` of a replay buffer; it is left as it is.

    Returns:
        ``[*B, n, 1]``, in units of the (scaled) reward.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor, NoiseSchedule, QNetwork
        >>> from redig.objectives import DIPOLoss
        >>> spec, names = Bounded(-1, 1, (3, 2)), ["observation", "action"]
        >>> actor = DiffusionActor(DenoisingMLP(2, 4), spec, names[:1], names[1:], NoiseSchedule(2))
        >>> critic = TensorDictModule(QNetwork(4, 2), in_keys=names, out_keys=["state_action_value"])
        >>> loss = DIPOLoss(None, actor, critic).make_value_estimator(gamma=0.9)
        >>> over, state = torch.ones(8, 3, 1, dtype=torch.bool), torch.zeros(8, 3, 4)
        >>> following = {"observation": state, "reward": torch.full((8, 3, 1), 50.0), "done": over, "terminated": over}
        >>> data = TensorDict({"observation": state, "action": torch.zeros(8, 3, 2), "next": following}, [8])
        >>> residual = bellman_residual(loss, data)  # a new critic says about 0, each episode ends with 50
        >>> residual.shape, bool((residual - 50).abs().max() < 2)
        (torch.Size([8, 3, 1]), True)
    """
    scored = data.clone(recurse=False)
    loss.qvalue_loss(scored)
    return scored[loss.tensor_keys.priority]


def density_ratio(
    embedding: Tensor, action: Tensor, buffer_embedding: Tensor, buffer_action: Tensor, num_neighbours: int = 50
) -> Tensor:
    """Density of a policy's pairs (h, a) over that of the buffer's, at the policy's pairs, from nearest neighbours.

    Among the k nearest of all other pairs, ``k_p`` belong to the policy and ``k - k_p`` to the buffer; the ratio is
    ``(k_p + 1) / N`` over ``(k - k_p + 1) / (M + 1)``. Every column is scaled to unit variance, and distances are
    averaged over the columns of h and of a separately, so that both count equally however wide h is. The estimate ends
    at about ``k`` (for ``N = M``): more cannot be seen from k neighbours. Where the two agree it scatters around 1
    with a standard deviation of about ``2 / sqrt(k)``. Give samples that are independent of each other: two actions
    for the same h are each other's neighbours. Memory grows with ``N (N + M)``.

    Args:
        embedding: of the policy's pairs, ``[N, H]``.
        action: ``[N, A]``.
        buffer_embedding: of the buffer's pairs, ``[M, H]``.
        buffer_action: ``[M, A]``.
        num_neighbours: k.

    Returns:
        ``[N]``. Its maximum estimates the one-step constant of Eq. 17, its mean 1 + the chi-square divergence.

    Raises:
        ValueError: if k is not in ``[1, N + M - 1]``.

    Examples:
        >>> import torch
        >>> generator = torch.Generator().manual_seed(0)
        >>> h = torch.rand(2, 1000, 1, generator=generator)
        >>> a = torch.rand(2, 1000, 1, generator=generator)
        >>> ratio = density_ratio(h[0], a[0] / 2, h[1], a[1])  # the policy keeps to half of the buffer's actions
        >>> 1.8 < ratio.median().item() < 2.2
        True
    """
    count, others = len(embedding), len(buffer_embedding)
    if not 1 <= num_neighbours < count + others:
        raise ValueError(f"num_neighbours: got {num_neighbours}, must be in [1, N + M - 1] = [1, {count + others - 1}]")
    blocks = (torch.cat([embedding, buffer_embedding]), torch.cat([action, buffer_action]))
    # less the first row, so that a column that never varies is exactly 0 and has no say
    scaled = [(block - block[0]) / block.std(0).clamp_min(1e-12) / math.sqrt(block.shape[-1]) for block in blocks]
    points = torch.cat(scaled, -1)
    distance = torch.cdist(points[:count], points)
    distance[:, :count].fill_diagonal_(torch.inf)
    nearest = distance.topk(num_neighbours, largest=False).indices
    own = (nearest < count).sum(-1)
    return (own + 1) / count * ((others + 1) / (num_neighbours - own + 1))


@torch.no_grad()
def coverage(loss: DiffusionActorCriticLoss, data: TensorDictBase, num_neighbours: int = 50) -> Tensor:
    """How much denser the backup's pairs (h', a') are than the buffer's (h, a), the C of Eq. 17 as a density ratio.

    ``|P f| <= C |f|`` holds in the L1 norm under the buffer's distribution if C is the largest ratio between the
    density of what the Bellman target reads, ``(h', a')`` with ``a'`` from the target actor, and that of what the
    critic was taught, ``(h, a)``. See :func:`density_ratio` for the estimate and its limits.

    Args:
        loss: the trained loss; embeddings are those of its actor's encoder, with target parameters.
        data: batch ``[*B]`` of a replay buffer, drawn at random; transitions that ended are left out.
        num_neighbours: k.

    Returns:
        ``[N]``, one for each robot and transition that did not end.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor, NoiseSchedule, QNetwork
        >>> from redig.objectives import DIPOLoss
        >>> spec, names = Bounded(-1, 1, (3, 2)), ["observation", "action"]
        >>> actor = DiffusionActor(DenoisingMLP(2, 4), spec, names[:1], names[1:], NoiseSchedule(2))
        >>> loss = DIPOLoss(None, actor, TensorDictModule(QNetwork(4, 2), names, ["state_action_value"]))
        >>> state, on = torch.randn(2, 64, 3, 4), torch.zeros(64, 3, 1, dtype=torch.bool)
        >>> data = {"observation": state[0], "action": torch.rand(64, 3, 2) * 2 - 1}
        >>> data = TensorDict({**data, "next": {"observation": state[1], "terminated": on}}, [64])
        >>> coverage(loss, data).shape
        torch.Size([192])
    """
    keys, following = loss.tensor_keys, data["next"]
    states = [_target_embedding(loss, part) for part in (following, data)]
    read = getattr(loss.actor_network, "embedding_keys", loss.actor_network.in_keys)
    with (
        set_exploration_type(loss.deterministic_sampling_mode),
        loss.target_actor_network_params.to_module(loss.actor_network),
    ):
        action = loss.actor_network(states[0].select(*loss.actor_network.in_keys))[loss.actor_network.out_keys[0]]
    embedding, buffer_embedding = (torch.cat([state[key] for key in read], -1) for state in states)
    ended = following[keys.terminated].squeeze(-1)
    if ended.ndim < action.ndim - 1:  # one flag for the team
        ended = ended.unsqueeze(-1)
    goes_on = ~ended.expand(action.shape[:-1])
    return density_ratio(
        embedding[goes_on],
        action[goes_on],
        buffer_embedding.flatten(0, -2),
        data[keys.action].flatten(0, -2),
        num_neighbours,
    )


def _target_embedding(loss: DiffusionActorCriticLoss, data: TensorDictBase) -> TensorDictBase:
    """What the target actor reads: the output of its encoder, or the observations where there is none."""
    if not loss.has_encoder:
        return data
    encoder = loss.encoder_network
    with loss.target_encoder_network_params.to_module(encoder):
        return encoder(data.select(*encoder.in_keys, *loss.actor_network.in_keys, strict=False))


def coverage_constant(ratio: float, gamma: float) -> float:
    """The C of Eq. 18 that follows from a one-step constant: ``(1 - gamma) / (1 - gamma ratio)``.

    With ``|P| <= ratio`` for each step, ``(1 - gamma)^2 sum_m gamma^(m-1) sum_{j<m} ratio^j`` is a geometric series. It
    converges for ``gamma ratio < 1`` only, that is, for a ratio hardly above 1: otherwise the bound says nothing.

    Args:
        ratio: the largest density ratio, see :func:`coverage`; 1 in the largest norm.
        gamma: discount factor (of a whole window, ``gamma^n``, for n-step targets).

    Returns:
        C, infinite if the series diverges.

    Raises:
        ValueError: if ``gamma`` is not in [0, 1) or ``ratio`` is negative.

    Examples:
        >>> coverage_constant(1.0, gamma=0.98), round(coverage_constant(1.01, gamma=0.98), 2)
        (1.0, 1.96)
        >>> coverage_constant(2.0, gamma=0.98)
        inf
    """
    _check_gamma(gamma)
    if not ratio >= 0:
        raise ValueError(f"ratio: got {ratio}, must be at least 0")
    return (1 - gamma) / (1 - gamma * ratio) if gamma * ratio < 1 else math.inf


def statistical_error(residual: float, coverage: float, gamma: float) -> float:
    """First term of Theorem 2 as printed: ``2 gamma C S / (1 - gamma)^2``.

    In the largest norm (C = 1) the proof needs ``S / (1 - gamma)`` only, which the printed term exceeds for ``gamma >=
    1/3``; below, the printed one is too small (0 at ``gamma = 0``, where the error is S).

    Args:
        residual: S, see :func:`bellman_residual`.
        coverage: C, see :func:`coverage_constant`.
        gamma: discount factor.

    Raises:
        ValueError: if ``gamma`` is not in [0, 1).

    Examples:
        >>> round(statistical_error(residual=0.1, coverage=1.0, gamma=0.9), 6)
        18.0
    """
    _check_gamma(gamma)
    return 2 * gamma * coverage * residual / (1 - gamma) ** 2


def algorithmic_error(num_iterations: float, max_reward: float, gamma: float) -> float:
    """Second term of Theorem 2 as printed: ``4 gamma^(M + 1) R_max / (1 - gamma)^2``.

    The proof needs ``2 gamma^M R_max / (1 - gamma)`` (Eq. 26 times ``gamma^M``), which the printed term exceeds for
    ``gamma >= 1/3``. M counts applications of the Bellman operator. With Polyak averaging at a rate tau a target needs
    some ``1 / tau`` updates to follow, so M is about tau times the number of updates.

    Args:
        num_iterations: M.
        max_reward: largest absolute reward.
        gamma: discount factor (of a whole window for n-step targets, whose reward is then the window's).

    Raises:
        ValueError: if ``gamma`` is not in [0, 1) or ``num_iterations`` is negative.

    Examples:
        >>> round(algorithmic_error(num_iterations=0, max_reward=1.0, gamma=0.5), 6)
        8.0
    """
    _check_gamma(gamma)
    if not num_iterations >= 0:
        raise ValueError(f"num_iterations: got {num_iterations}, must be at least 0")
    return 4 * gamma ** (num_iterations + 1) * max_reward / (1 - gamma) ** 2


def _check_gamma(gamma: float) -> None:
    if not 0 <= gamma < 1:
        raise ValueError(f"gamma: got {gamma}, must be in [0, 1)")
