"""Theorem 1 as functions: what separates the actions that a diffusion policy draws from those that it was taught.

``KL <= prior mismatch + matching error + discretization error`` (Eq. 13). What the paper leaves open in each term, and
which term to look at when a run goes wrong: ``docs/theory.md``.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor

from redig.modules import DDPM, DiffusionActor, NoiseSchedule, Sampler


def prior_mismatch(schedule: NoiseSchedule, action: Tensor) -> Tensor:
    """How far the last noisy action is from the Gaussian that sampling starts from, last term of Eq. 6, closed form.

    ``KL(q(a^K | a^0) || N(0, I)) = (alpha (|a^0|^2 - A) - A log(1 - alpha)) / 2`` for one clean action, with
    ``alpha = alphas_cumprod[-1]``. Its mean over a data set is the term of the evidence lower bound, and by convexity
    an upper bound on the paper's ``KL(q(a^K) || N(0, I))``, where ``q(a^K)`` is a mixture over the clean actions;
    :func:`prior_mismatch_floor` bounds the same number from below. Without data, a corner such as ``torch.ones(A)``
    gives the worst case of all actions within the bounds.

    Args:
        schedule: the schedule of the policy.
        action: clean actions ``[*B, A]``, normalised to [-1, 1].

    Returns:
        ``[*B]`` (nats).

    Examples:
        >>> import torch
        >>> from redig.modules import NoiseSchedule
        >>> corner = torch.ones(2)
        >>> [round(prior_mismatch(NoiseSchedule(steps, "linear"), corner).item(), 2) for steps in (20, 100)]
        [1.7, 0.45]
        >>> prior_mismatch(NoiseSchedule(20, "cosine"), corner).item() < 1e-4
        True
    """
    alpha = schedule.signal(schedule.num_steps - 1)
    excess = action.double().square() - 1
    return ((alpha * excess - math.log1p(-alpha)).sum(-1) / 2).to(action.dtype)


def prior_mismatch_floor(schedule: NoiseSchedule, action: Tensor) -> Tensor:
    """Lower bound on ``KL(q(a^K) || N(0, I))``: the divergence of the Gaussian with the moments of ``q(a^K)``.

    No distribution with a given mean and covariance is nearer to a Gaussian than the Gaussian that shares them. Here
    the mean is ``sqrt(alpha) E[a^0]`` and the covariance ``alpha Cov[a^0] + (1 - alpha) I``.

    Args:
        schedule: the schedule of the policy.
        action: clean actions ``[*B, A]`` of the data set, normalised to [-1, 1].

    Returns:
        a scalar (nats), at most ``prior_mismatch(schedule, action).mean()``.

    Examples:
        >>> import torch
        >>> from redig.modules import NoiseSchedule
        >>> schedule, action = NoiseSchedule(100, "linear"), torch.tensor([[0.8], [0.8], [0.8], [0.8], [-0.8]])
        >>> round(prior_mismatch_floor(schedule, action).item(), 3)
        0.055
        >>> round(prior_mismatch(schedule, action).mean().item(), 3)
        0.16
    """
    alpha = schedule.signal(schedule.num_steps - 1)
    flat = action.reshape(-1, action.shape[-1]).double()
    mean = flat.mean(0)
    centred = flat - mean
    identity = torch.eye(len(mean), dtype=flat.dtype, device=flat.device)
    change = alpha * (centred.T @ centred / len(flat) - identity)  # covariance of q(a^K) less that of the prior
    return ((change.trace() + alpha * mean.square().sum() - torch.logdet(identity + change)) / 2).to(action.dtype)


def matching_error(
    actor: DiffusionActor,
    data: TensorDictBase,
    action: NestedKey | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Error of the predicted noise at each step, ``E |eps - eps_theta(a^k, k | h)|^2`` (Eq. 11), on data.

    Its sum is the term as printed. That sum is not in nats, see :func:`matching_divergence`, and a perfect denoiser has
    it, too: since many pairs of action and noise give the same noisy action, ``Var(eps | a^k, h)`` remains. So compare
    policies of one schedule on the same data, with equally seeded generators; the difference is what one of them has
    yet to learn.

    Args:
        actor: a trained :class:`~redig.modules.DiffusionActor`.
        data: batch with the embeddings that the actor reads, ``[*B, H]``, and clean actions ``[*B, A]``. A
            policy's encoder, such as ``policy[0]`` of :func:`redig.policy.load_policy`, writes the former.
        action: key of the clean actions; default: the one that the actor writes.
        generator: source of the noise; one draw for each action and step.

    Returns:
        ``[K]``, squared norms summed over A, mean over the batch.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor, NoiseSchedule
        >>> spec, schedule = Bounded(-1, 1, (2,)), NoiseSchedule(20)
        >>> actor = DiffusionActor(DenoisingMLP(2, 8), spec, ["embedding"], ["action"], schedule)
        >>> data = TensorDict({"embedding": torch.randn(512, 8), "action": torch.zeros(512, 2)}, [512])
        >>> error = matching_error(actor, data)  # untrained: about as bad as predicting no noise, E |eps|^2 = 2
        >>> error.shape, bool((error.mean() - 2).abs() < 0.3)
        (torch.Size([20]), True)
    """

    def squared(k: int, clean: Tensor, noisy: Tensor, noise: Tensor, predicted: Tensor) -> Tensor:
        return (predicted - noise).square()

    return _mean_at_each_step(squared, actor, data, action, generator)


def matching_divergence(
    actor: DiffusionActor,
    data: TensorDictBase,
    action: NestedKey | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """``KL(q(a^{k-1} | a^k, a^0) || p_theta(a^{k-1} | a^k, h))`` at each step (Eq. 6), on data, of the chain as it is.

    Both are Gaussians with the posterior's variance ``sigma^2``, and their means differ by ``c0 (a^0 - a^0_theta)``
    with c0 of :meth:`~redig.modules.NoiseSchedule.posterior` and the clamped estimate ``a^0_theta``. Without the clamp
    it would be :func:`matching_error` times ``beta^2 / (2 sigma^2 (1 - beta) (1 - alpha^k))`` (Ho et al., 2020, Eq.
    12), where the paper has 1. At the first step the posterior has no variance; that of the second is used (Nichol and
    Dhariwal, 2021).

    Args:
        actor: a trained :class:`~redig.modules.DiffusionActor`, its schedule of at least 2 steps.
        data: batch with embeddings ``[*B, H]`` and clean actions ``[*B, A]``, see :func:`matching_error`.
        action: key of the clean actions; default: the one that the actor writes.
        generator: source of the noise.

    Returns:
        ``[K]`` (nats), mean over the batch.

    Raises:
        ValueError: for a schedule of one step.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DenoisingMLP, DiffusionActor, NoiseSchedule
        >>> spec, schedule = Bounded(-1, 1, (2,)), NoiseSchedule(100, "linear")
        >>> actor = DiffusionActor(DenoisingMLP(2, 8), spec, ["embedding"], ["action"], schedule)
        >>> data = TensorDict({"embedding": torch.randn(512, 8), "action": torch.zeros(512, 2)}, [512])
        >>> divergence = matching_divergence(actor, data)
        >>> bool(divergence[50] < 0.1 * matching_error(actor, data)[50])  # the paper's 1 counts most steps too much
        True
    """
    schedule = actor.module.schedule
    if schedule.num_steps < 2:
        raise ValueError(f"schedule: got {schedule.num_steps} step, must have at least 2")

    def divergence(k: int, clean: Tensor, noisy: Tensor, noise: Tensor, predicted: Tensor) -> Tensor:
        signal, sigma = schedule.signal(k), schedule.posterior(max(k, 1), max(k, 1) - 1)[2]
        estimate = ((noisy - math.sqrt(1 - signal) * predicted) / math.sqrt(signal)).clamp(-1, 1)
        return (schedule.posterior(k, k - 1)[0] * (clean - estimate) / sigma).square() / 2

    return _mean_at_each_step(divergence, actor, data, action, generator)


@torch.no_grad()
def _mean_at_each_step(
    score: Callable[..., Tensor],
    actor: DiffusionActor,
    data: TensorDictBase,
    action: NestedKey | None,
    generator: torch.Generator | None,
) -> Tensor:
    """``score(k, clean, noisy, noise, predicted)`` ``[*B, A]`` at each step k, summed over A, mean over B: ``[K]``."""
    schedule, denoise = actor.module.schedule, _conditioned(actor, data)
    clean = actor.module.normalize(data[actor.out_keys[0] if action is None else action])
    scores = []
    for k in range(schedule.num_steps):
        step = torch.full(clean.shape[:-1], k, device=clean.device)
        noise = torch.empty_like(clean).normal_(generator=generator)
        noisy = schedule.add_noise(clean, noise, step)
        scores.append(score(k, clean, noisy, noise, denoise(noisy, step)).sum(-1).mean())
    return torch.stack(scores)


def discretization_term(schedule: NoiseSchedule) -> Tensor:
    """``sum_k (beta^k)^2``, Eq. 12 without the constant that the paper leaves open.

    It has no unit, ranks a schedule that hardly adds noise as the best, and for ``cosine`` does not fall as K grows.
    :func:`discretization_error` measures what a chain of few steps costs.

    Args:
        schedule: the schedule of the policy.

    Returns:
        a scalar.

    Examples:
        >>> from redig.modules import NoiseSchedule
        >>> [round(discretization_term(NoiseSchedule(steps)).item(), 1) for steps in (20, 100, 1000)]
        [2.5, 2.8, 2.8]
        >>> round(discretization_term(NoiseSchedule(20, "linear")).item(), 3)
        0.003
    """
    return schedule.betas.square().sum()


@torch.no_grad()
def discretization_error(
    actor: DiffusionActor,
    data: TensorDictBase,
    sampler: Sampler | None = None,
    reference: Sampler | None = None,
    num_samples: int = 64,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Energy distance between the actions that two chains with the same weights draw: a measured stand-in for Eq. 12.

    ``2 E|x - y| - E|x - x'| - E|y - y'|`` for actions x, x' of the one and y, y' of the other chain, independent of
    each other, for each embedding. It is zero only if the two distributions are the same (Szekely and Rizzo, 2013), and
    at most twice the Wasserstein-1 distance. It says what leaving out steps, or noise, costs; how far ``reference`` is
    from a continuous process stays unseen, since the denoiser knows no finer steps.

    Args:
        actor: a trained :class:`~redig.modules.DiffusionActor`.
        data: batch with the embeddings that the actor reads, ``[*B, H]``.
        sampler: the chain to judge; default: the actor's own.
        reference: the chain to compare with; default: :class:`~redig.modules.DDPM` with all steps and all noise.
        num_samples: S, actions of each chain for each embedding, at least 2.
        generator: source of latents and noise.

    Returns:
        ``[*B]``, for actions normalised to [-1, 1]. The estimate has no bias, so single values may be below 0; average
        over a batch.

    Raises:
        ValueError: if ``num_samples`` is less than 2.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from torchrl.data import Bounded
        >>> from redig.modules import DDPM, DiffusionActor
        >>> standard_normal = lambda action, step, embedding: action * 0  # a denoiser that sees no noise
        >>> actor = DiffusionActor(standard_normal, Bounded(-1, 1, (2,)), ["embedding"], ["action"])
        >>> error = discretization_error(actor, TensorDict({"embedding": torch.randn(16, 8)}, [16]), DDPM(5))
        >>> error.shape
        torch.Size([16])
    """
    if num_samples < 2:
        raise ValueError(f"num_samples: got {num_samples}, must be at least 2")
    policy, denoise = actor.module, _conditioned(actor, data)
    batch = data[actor.embedding_keys[0]].shape[:-1]

    def draw(chain: Sampler) -> Tensor:
        latent = torch.empty(num_samples, *batch, policy.low.shape[-1], device=policy.low.device)
        return chain(denoise, latent.normal_(generator=generator), policy.schedule, generator).movedim(0, -2)

    first, second = draw(sampler or policy.sampler), draw(reference or DDPM())
    within = sum(torch.cdist(x, x).sum((-2, -1)) for x in (first, second)) / (num_samples * (num_samples - 1))
    return 2 * torch.cdist(first, second).mean((-2, -1)) - within


def _conditioned(actor: DiffusionActor, data: TensorDictBase) -> Callable[[Tensor, int | Tensor], Tensor]:
    """The actor's denoiser given the embeddings ``[*B, H]`` of a batch, for noisy actions ``[*S, *B, A]``."""
    condition = torch.cat([data[key] for key in actor.embedding_keys], -1)

    def denoise(noisy: Tensor, step: int | Tensor) -> Tensor:
        step = torch.as_tensor(step, device=noisy.device)
        return actor.module.denoiser(noisy, step, condition.expand(*noisy.shape[:-1], -1))

    return denoise
