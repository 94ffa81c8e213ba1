"""N-step returns for teams: one window for the team, ended separately for each robot."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.utils import NestedKey
from torch import Tensor


class MultiStep:
    """Turn trajectories into n-step transitions, robot by robot; use it as a collector's ``postproc``.

    TorchRL's own ``MultiStep`` knows one done flag a transition. In a team a robot may be done (it has collided) while
    its team drives on: its return must end there, while its teammates' graph n steps later still contains it. So
    rewards are summed until the robot's own termination, and the next observation is the team's, n steps later or at
    the episode's end (or at the end of the given piece of trajectory, with a shorter window).

    Args:
        n_steps: length of the window.
        gamma: discount factor.
        keep: root keys to keep.
        next_keys: keys under ``"next"`` to take from the end of the window.
        reward: key of the reward under ``"next"``, ``[*B, T, n, 1]``.
        robot_terminated: key of the robots' flags under ``"next"``, ``[*B, T, n, 1]``, of any dtype.
        terminated: where to write the robots' flags of the window, as bool, under ``"next"``; also written as ``done``.
        done: key of the episode's end under ``"next"``, ``[*B, T, 1]``.

    Raises:
        ValueError: if ``n_steps`` is less than 1 or ``gamma`` not in [0, 1].

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> zeros = torch.zeros(1, 3, 2, 1)
        >>> following = {"observation": zeros, "reward": zeros + 1, "info": {"terminated": zeros}}
        >>> following = {"agents": following, "done": torch.zeros(1, 3, 1, dtype=torch.bool)}
        >>> data = TensorDict({"agents": {"observation": zeros}, "next": following}, [1, 3])
        >>> out = MultiStep(n_steps=2, gamma=0.5, keep=[("agents", "observation")])(data)
        >>> out["next", "agents", "reward"][0, :, 0, 0]
        tensor([1.5000, 1.5000, 1.0000])
    """

    def __init__(
        self,
        n_steps: int,
        gamma: float,
        keep: list[NestedKey] | None = None,
        next_keys: list[NestedKey] | None = None,
        reward: NestedKey = ("agents", "reward"),
        robot_terminated: NestedKey = ("agents", "info", "terminated"),
        terminated: NestedKey = ("agents", "terminated"),
        done: NestedKey = "done",
    ) -> None:
        if n_steps < 1:
            raise ValueError(f"n_steps: got {n_steps}, must be at least 1")
        if not 0 <= gamma <= 1:
            raise ValueError(f"gamma: got {gamma}, must be in [0, 1]")
        self.n_steps, self.gamma = n_steps, gamma
        self.keep = keep or [("agents", "observation"), ("agents", "action")]
        self.next_keys = next_keys or [("agents", "observation")]
        self.reward, self.robot_terminated, self.terminated, self.done = reward, robot_terminated, terminated, done

    def __call__(self, data: TensorDictBase) -> TensorDictBase:
        """Trajectories ``[*B, T]`` in time order to transitions of the same shape."""
        following = data["next"]
        reward, robot_terminated = following[self.reward], following[self.robot_terminated] > 0
        done = following[self.done].unsqueeze(-1)  # [*B, T, 1, 1]
        time = data.ndim - 1
        length = data.shape[time]
        total, ended = torch.zeros_like(reward), torch.zeros_like(robot_terminated)
        open_ = torch.ones_like(done)
        last = torch.arange(length, device=reward.device).view(length, 1, 1).expand(done.shape).clone()
        for k in range(min(self.n_steps, length)):
            total += self.gamma**k * _ahead(reward, k, time) * (open_ & ~ended)
            ended = ended | (_ahead(robot_terminated, k, time) & open_)
            last = torch.where(open_, torch.arange(length, device=last.device).view(length, 1, 1) + k, last)
            inside = torch.arange(length, device=last.device).view(length, 1, 1) + k + 1 < length
            open_ = open_ & ~_ahead(done, k, time) & inside
        out = data.select(*self.keep, strict=False)
        end = last.view(*data.shape)  # [*B, T]
        out["next"] = following.select(*self.next_keys).gather(time, end)
        start = torch.arange(length, device=last.device).view(length, 1, 1)
        out["next"].update(TensorDict({self.reward: total, self.terminated: ended}, data.shape))
        out["next", _sibling(self.terminated, "done")] = ended.clone()
        out["steps_to_next_obs"] = (last - start + 1).expand(reward.shape).clone()
        return out


def _ahead(value: Tensor, k: int, dim: int) -> Tensor:
    """``value`` k steps later along ``dim``; entries without one are filled with zeros."""
    if k == 0:
        return value
    kept = value.narrow(dim, k, value.shape[dim] - k)
    return torch.cat([kept, torch.zeros_like(value.narrow(dim, 0, k))], dim)


def _sibling(key: NestedKey, name: str) -> NestedKey:
    return name if isinstance(key, str) else (*key[:-1], name)
