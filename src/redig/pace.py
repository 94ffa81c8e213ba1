"""A trained policy at another pace: the same motion in more time, where wheels slip or turn slowly."""

from __future__ import annotations

from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase

from redig.deploy.messages import VELOCITY, check_pace
from redig.policy import ACTION, OBSERVATION


class Paced(TensorDictModuleBase):
    """A team's policy in slow motion: time scaling (Hollerbach, Dynamic Scaling of Manipulator Trajectories, 1984).

    The policy is told velocities divided by ``pace`` and its commands are multiplied by it. A team then takes the paths
    that it would take, with robots as quick as ``max_speed / pace`` and ``max_acceleration / pace**2``, in
    ``1 / pace`` of the time: at half the pace there is four times the grip, and twice the turning. Nothing is trained.
    The scenario's ``max_speed`` must be multiplied by ``pace``, too, as commands are shortened to it.

    Args:
        policy: reads the observations of :class:`~redig.envs.FormationNavigation` and writes velocity commands.
        pace: over that of the training; greater than 0 and at most 1.

    Raises:
        ValueError: for a pace out of this range.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> from tensordict.nn import TensorDictModule
        >>> damper = TensorDictModule(lambda seen: -seen[..., 2:4], [OBSERVATION], [ACTION])
        >>> team = TensorDict({"agents": {"observation": torch.ones(1, 5, 9)}}, [1])
        >>> Paced(damper, 0.5)(team)["agents", "action"][0, 0]  # of a velocity of 2 m/s, half
        tensor([-1., -1.])
    """

    def __init__(self, policy: TensorDictModuleBase, pace: float) -> None:
        super().__init__()
        self.policy, self.pace = policy, check_pace(pace)
        self.in_keys, self.out_keys = policy.in_keys, policy.out_keys

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """What the policy writes, its commands ``[*B, n, 2]`` (m/s) at this pace."""
        seen = tensordict[OBSERVATION].clone()
        seen[..., VELOCITY] /= self.pace
        acted = self.policy(tensordict.copy().set(OBSERVATION, seen))
        tensordict.update(acted.select(*self.out_keys))
        return tensordict.set(ACTION, self.pace * acted[ACTION])
