"""The policy of one robot: its own state and what it has heard of its neighbours in, a velocity command out."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from redig.deploy.messages import VELOCITY, RobotState, check_pace

WIDTHS = (7, 9)  # of an observation: without and with the direction to the nearest obstacle


class _Network(Protocol):
    """What a robot runs: an exported policy or a module policy."""

    config: dict[str, Any] | None
    environment: dict[str, Any]
    stochastic: bool
    ego: bool
    width: int

    def __call__(
        self, observation: ArrayLike, *, latent: ArrayLike | None = None, noise: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """Action ``[A]`` of the first of the robots that ``observation`` ``[n, F]`` is of."""


class RobotPolicy:
    """A trained policy on one robot (decentralised execution, Sec. 3.2): states in, velocity command out.

    The command is that which the policy of the whole team gives this robot if it hears exactly these neighbours.
    Neighbours beyond the encoder's radius make no difference. There may be any number of them, also more than in
    training, and their order does not matter. Nothing is kept from call to call, and stamps are not looked at: who
    calls decides which messages are fresh enough. That a robot which has arrived holds is the work of the scenario in
    training, and on a robot that of the caller.

    Args:
        policy: a file, ``.onnx`` as written by ``export_policy(..., ego=True)``, which needs no torch, or
            ``.safetensors`` as written by :func:`~redig.policy.save_policy`, which does, and is run with its own
            sampler and without noise; or an :class:`~redig.deploy.ExportedPolicy` or
            :class:`~redig.deploy.ModulePolicy` that was loaded with other options.
        pace: drive in slow motion, see :class:`~redig.pace.Paced`; the same for the whole team.

    Attributes:
        network: what it runs.
        config: fields of the :class:`~redig.policy.PolicyConfig`, or ``None``.
        environment: arguments of the scenario that it was trained in.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is neither kind of file, is damaged, or is not a policy of one robot that reads the
            scenario's observations; for a pace that is not greater than 0 and at most 1.

    Examples:
        >>> import tempfile
        >>> from redig.policy import PolicyConfig, build_policy, save_policy
        >>> config = PolicyConfig(observation_dim=9, sampling_steps=5, noise_ratio=0.0)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     save_policy(f"{folder}/policy.safetensors", build_policy(config), config)
        ...     robot = RobotPolicy(f"{folder}/policy.safetensors")
        >>> own = RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 0.9, (0.0, 1.0))
        >>> mate = RobotState("robot_1", 0.0, (-0.5, 0.5), (0.0, 0.0), (4.5, 0.5), 0.4, (0.0, 1.0))
        >>> robot(own, [mate]).shape, robot(own).shape
        ((2,), (2,))
    """

    def __init__(self, policy: str | Path | _Network, pace: float = 1.0) -> None:
        self.pace = check_pace(pace)
        self.network = _load(policy) if isinstance(policy, str | Path) else policy
        self.config, self.environment = self.network.config, self.network.environment
        if not self.network.ego:
            raise ValueError("policy: it acts for whole teams; export it with ego=True")
        if self.network.width not in WIDTHS:
            allowed = " or ".join(map(str, WIDTHS))
            raise ValueError(
                f"policy: it reads {self.network.width} numbers a robot, those of the scenario are {allowed}"
            )
        self.network(np.zeros((2, self.network.width), np.float32))  # the first call allocates memory and takes longest

    def __call__(
        self,
        own: RobotState,
        neighbours: Iterable[RobotState] = (),
        *,
        latent: ArrayLike | None = None,
        noise: ArrayLike | None = None,
    ) -> NDArray[np.float32]:
        """Velocity command ``[2]`` (m/s) in the world frame.

        Args:
            own: state of this robot.
            neighbours: what others sent, at most one message each.
            latent: ``[2]``; default: drawn. Stochastic policies only.
            noise: ``[S, 2]``, of the S transitions that the sampler adds noise to; default: drawn. Likewise.

        Raises:
            ValueError: if a state cannot be used (``RobotState.check``), two are
                of the same robot, or latent and noise do not fit the policy.
        """
        states = [own, *neighbours]
        seen: set[str] = set()
        for state in states:
            state.check()
            if state.robot in seen:
                raise ValueError(f"neighbours: got more than one state of {state.robot}, must be one a robot")
            seen.add(state.robot)
        observation = np.array([state.observation() for state in states], np.float32)
        observation[:, VELOCITY] /= self.pace
        return self.pace * self.network(observation[:, : self.network.width], latent=latent, noise=noise)


def _load(path: str | Path) -> _Network:
    suffix = Path(path).suffix
    if suffix == ".onnx":
        from redig.deploy.runtime import load_policy

        return load_policy(path)
    if suffix == ".safetensors":
        from redig.deploy.module import ModulePolicy

        return ModulePolicy(path)
    raise ValueError(f"policy: got {path}, must be a .onnx or .safetensors file")
