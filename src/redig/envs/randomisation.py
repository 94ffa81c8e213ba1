"""What separates a simulator from robots, as TorchRL transforms: commands that come late and sensors that are noisy.

Together with ``acceleration_range`` of :class:`~redig.envs.FormationNavigation` they keep a team in training from
relying on one simulator. Noise and delays are drawn from torch's generator.
"""

from __future__ import annotations

import math

import torch
from tensordict import TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor
from torchrl.data import Composite, Unbounded
from torchrl.envs import Transform

PAST_ACTIONS, DELAY = "past_actions", "action_delay"


class ActionDelay(Transform):
    """Environment transform that carries out each command some steps after it was given.

    A team's delay is drawn at its reset, uniformly from ``low`` to ``high`` steps; until its first command is due, a
    team carries out zeros. What is recorded as the action is the command as given. The commands under way are in the
    tensordict, as ``"past_actions"`` ``[*B, high, ...]``, latest first, beside ``"action_delay"`` ``[*B, 1]``.

    Args:
        low: smallest delay (steps).
        high: largest delay (steps), at least 1.
        action: key of the action.

    Raises:
        ValueError: unless ``0 <= low <= high`` and ``1 <= high``.

    Examples:
        >>> from tensordict.nn import TensorDictModule
        >>> from torchrl.envs import TransformedEnv
        >>> from redig.envs import make_env
        >>> ahead = TensorDictModule(lambda x: torch.tensor([1.0, 0.0]).expand(*x.shape[:-1], 2),
        ...                          [("agents", "observation")], [("agents", "action")])
        >>> env = TransformedEnv(make_env(1, max_acceleration=10.0), ActionDelay(2, 2))
        >>> env.rollout(4, ahead)["next", "agents", "info", "velocity"][0, :, 0, 0]  # two steps at rest
        tensor([0., 0., 1., 1.])
    """

    def __init__(self, low: int, high: int, action: NestedKey = ("agents", "action")) -> None:
        if not (0 <= low <= high and high >= 1):
            raise ValueError(f"action_delay: got {low} to {high} steps, must be 0 <= low <= high and high at least 1")
        super().__init__(in_keys_inv=[action], out_keys_inv=[action])
        self.low, self.high, self.action = low, high, action

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        axis = tensordict.ndim
        action, delay = tensordict[self.action], tensordict[DELAY]
        latest_first = torch.cat([action.unsqueeze(axis), tensordict[PAST_ACTIONS]], axis)
        due = delay.reshape(*delay.shape, *[1] * (action.ndim - axis))
        executed = latest_first.take_along_dim(due, axis).squeeze(axis)
        return tensordict.set(PAST_ACTIONS, latest_first.narrow(axis, 0, self.high)).set(self.action, executed)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.update(tensordict.select(PAST_ACTIONS, DELAY))

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        batch = tensordict_reset.batch_size  # those that are not reset keep what they have: TorchRL sees to it
        device = tensordict_reset.device
        shape = self.parent.full_action_spec[self.action].shape[len(batch) :]
        return tensordict_reset.update(
            {
                PAST_ACTIONS: torch.zeros(*batch, self.high, *shape, device=device),
                DELAY: torch.randint(self.low, self.high + 1, (*batch, 1), device=device),
            }
        )

    def transform_observation_spec(self, observation_spec: Composite) -> Composite:
        """Add what is kept in the tensordict."""
        batch = self.parent.batch_size
        shape, device = self.parent.full_action_spec[self.action].shape[len(batch) :], observation_spec.device
        observation_spec[PAST_ACTIONS] = Unbounded((*batch, self.high, *shape), device)
        observation_spec[DELAY] = Unbounded((*batch, 1), device, torch.int64)
        return observation_spec


class ObservationNoise(Transform):
    """Environment transform that adds Gaussian noise to what robots sense, anew at each step; the task is as it was.

    Position, velocity and the distance to the nearest obstacle each get noise of their own. The goal, relative to the
    robot, errs with the position, as it does for a robot that knows where its goal is and errs in where itself is.

    Args:
        std: standard deviation, in m for positions and distances and in m/s for velocities; greater than 0.
        observation: key of an observation in the layout of :class:`~redig.envs.FormationNavigation`.

    Raises:
        ValueError: if ``std`` is not a positive number.

    Examples:
        >>> from torchrl.envs import TransformedEnv
        >>> from redig.envs import make_env
        >>> env = TransformedEnv(make_env(1), ObservationNoise(0.02))
        >>> data = env.reset()
        >>> seen, true = data["agents", "observation"], data["agents", "info", "position"]
        >>> 0 < (seen[..., :2] - true).abs().max().item() < 0.2
        True
    """

    def __init__(self, std: float, observation: NestedKey = ("agents", "observation")) -> None:
        if not 0 < std < math.inf:
            raise ValueError(f"observation_noise: got {std}, must be a positive number")
        super().__init__(in_keys=[observation], out_keys=[observation])
        self.std = std

    def _apply_transform(self, observation: Tensor) -> Tensor:
        noise = self.std * torch.randn_like(observation[..., :5])
        position, velocity, distance = noise.split([2, 2, 1], -1)
        exact = torch.zeros_like(observation[..., 7:])
        return observation + torch.cat([position, velocity, -position, distance, exact], -1)

    def _reset(self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase) -> TensorDictBase:
        return self._call(tensordict_reset)
