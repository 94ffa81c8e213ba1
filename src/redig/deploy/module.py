"""A policy file run with torch for one robot, called like an exported policy."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from redig.deploy.parts import Condition, denoiser_step
from redig.deploy.transitions import chain_transitions
from redig.modules import Sampler
from redig.policy import load_policy, read_header


class ModulePolicy:
    """The action of one robot by torch: what ``export_policy(..., ego=True)`` writes, without a file in between.

    It starts at once, where an export takes seconds, and takes more time a call than the file does.

    Args:
        path: of a file of :func:`~redig.policy.save_policy`.
        sampler: in place of the one that it was trained with.
        stochastic: draw a latent and the sampler's noise; by default the latent is zero and there is no noise.
        seed: of what it draws; ``None``: another one each time.

    Attributes:
        config: fields of the :class:`~redig.policy.PolicyConfig`.
        environment: arguments of the scenario that it was trained in.
        stochastic: whether it takes a latent and noise.
        ego: ``True``: it gives the action of the first robot only.
        width: of an observation.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a policy file, is damaged, or the sampler does not fit it.

    Examples:
        >>> import tempfile
        >>> from redig.modules import DDIM
        >>> from redig.policy import PolicyConfig, build_policy, save_policy
        >>> config = PolicyConfig(observation_dim=9)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_policy(f"{folder}/policy.safetensors", build_policy(config), config)
        ...     robot = ModulePolicy(f"{folder}/policy.safetensors", sampler=DDIM(num_steps=5))
        >>> robot(np.zeros((3, 9))).shape  # itself and two neighbours
        (2,)
    """

    ego = True

    def __init__(
        self, path: str | Path, *, sampler: Sampler | None = None, stochastic: bool = False, seed: int | None = None
    ) -> None:
        config, self.environment = read_header(path)
        self.config: dict[str, Any] | None = asdict(config)
        self.width, self.stochastic = config.observation_dim, stochastic
        encoder, actor = load_policy(path, sampler=sampler)
        policy = actor.module
        self._denormalize, self._action_dim = policy.denormalize, len(policy.low)
        self._denoiser = denoiser_step(policy.denoiser)
        self._before = Condition(encoder.module, self._denoiser, ego=True)
        transitions = chain_transitions(policy.sampler, policy.schedule, deterministic=not stochastic)
        with torch.no_grad():
            times = self._denoiser.times([transition.step for transition in transitions])
        self._chain = list(zip(transitions, times, strict=True))
        self._noises = sum(transition.sigma > 0 for transition in transitions)
        self._generator = np.random.default_rng(seed)

    @torch.inference_mode()
    def __call__(
        self, observation: ArrayLike, *, latent: ArrayLike | None = None, noise: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """Action ``[A]`` (in the units of the action bounds) of the first robot.

        Args:
            observation: ``[n, F]``, of this robot and its neighbours, any n.
            latent: ``[A]``; default: drawn. With ``stochastic`` only.
            noise: ``[S, A]``, of the S transitions that the sampler adds noise to; default: drawn. Likewise.

        Raises:
            ValueError: if a shape does not fit the policy, or the observation is not finite.
        """
        observation = np.asarray(observation, np.float32)
        if observation.ndim != 2 or observation.shape[-1] != self.width or len(observation) < 1:
            got = f"got shape {list(observation.shape)}"
            raise ValueError(f"observation: {got}, expected [n, {self.width}] with n of at least 1")
        if not np.isfinite(observation).all():
            raise ValueError("observation: got values that are not finite")
        action, added = self._drawn("latent", latent, [1]), self._drawn("noise", noise, [self._noises, 1])
        rows, clean, drawn = self._before(torch.from_numpy(observation).unsqueeze(0)), action, 0
        for transition, time in self._chain:
            predicted, older = self._denoiser(action, time, rows), clean
            clean = (transition.of_action * action + transition.of_predicted * predicted).clamp(-1, 1)
            action = transition.c0 * clean + transition.ck * action + transition.c_older * older
            if transition.sigma > 0:
                action, drawn = action + transition.sigma * added[drawn], drawn + 1
        return self._denormalize(action).squeeze(0).numpy()

    def _drawn(self, name: str, value: ArrayLike | None, shape: list[int]) -> Tensor:
        """Latent ``[1, A]`` or noise ``[S, 1, A]``, given without the one; zeros for a policy without noise."""
        shape = [*shape, self._action_dim]
        if value is None:
            drawn = self._generator.standard_normal(shape, np.float32) if self.stochastic else np.zeros(shape)
            return torch.from_numpy(drawn).float()
        if not self.stochastic:
            raise ValueError(f"{name}: this policy takes none; load it with stochastic=True")
        value, expected = np.asarray(value, np.float32), [*shape[:-2], shape[-1]]
        if list(value.shape) != expected:
            raise ValueError(f"{name}: got shape {list(value.shape)}, expected {expected}")
        return torch.from_numpy(value.reshape(shape))
