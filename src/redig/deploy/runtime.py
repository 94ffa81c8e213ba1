"""Exported policies on a robot: numpy and ONNX Runtime, neither torch nor TorchRL."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

try:
    import onnxruntime
except ImportError as error:
    raise ImportError("redig.deploy.runtime needs ONNX Runtime: pip install 'redig[onnx]'") from error

FORMAT = "redig-onnx-1"


class ExportedPolicy:
    """A policy from a file, as a function: observations in, actions out. Made by :func:`load_policy`.

    Args:
        session: of ONNX Runtime.
        header: what :func:`~redig.deploy.export_policy` wrote beside the graph.
        seed: of the latent and the noise that it draws; ``None``: another one each time.

    Attributes:
        config: fields of the :class:`~redig.policy.PolicyConfig`, or ``None``.
        environment: arguments of the scenario that it was trained in.
        sampler: name and options of the sampler.
        stochastic: whether it takes a latent and noise.
        ego: whether it gives the action of the first robot only.
        width: of an observation, or embedding.

    Examples:
        >>> import tempfile
        >>> from redig.deploy import export_policy, load_policy
        >>> from redig.policy import PolicyConfig, build_policy
        >>> policy = build_policy(PolicyConfig(observation_dim=9, sampling_steps=5))
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     export_policy(policy, f"{folder}/policy.onnx", stochastic=True)
        ...     robots = load_policy(f"{folder}/policy.onnx", seed=0)
        >>> robots.sampler["num_steps"]
        5
        >>> team = np.zeros((5, 9))  # all of them in one place
        >>> robots(team).shape, np.ptp(robots(team, latent=np.ones((5, 2)), noise=np.zeros((4, 5, 2))), axis=0).tolist()
        ((5, 2), [0.0, 0.0])
    """

    def __init__(self, session: onnxruntime.InferenceSession, header: dict[str, Any], seed: int | None = None) -> None:
        self.config, self.environment, self.sampler = header["policy"], header["environment"], header["sampler"]
        self._session, self._generator = session, np.random.default_rng(seed)
        first, *random = session.get_inputs()
        self._input, self.width = first.name, first.shape[-1]
        shape = session.get_outputs()[0].shape
        self._action_dim, self.ego = shape[-1], len(shape) == 2
        self.stochastic = bool(random)
        self._steps = {value.name: value.shape[: -len(shape)] for value in random}  # the noise has a dimension more

    def __call__(
        self, observation: ArrayLike, *, latent: ArrayLike | None = None, noise: ArrayLike | None = None
    ) -> NDArray[np.float32]:
        """Actions (in the units of the action bounds) of robots that see ``observation``.

        Args:
            observation: ``[*B, n, F]``, of teams of n robots, any n; embeddings ``[*B, n, H]`` for an actor that was
                exported alone.
            latent: ``[*B, n, A]``, ``[*B, A]`` with ``ego``; default: drawn. Stochastic policies only.
            noise: ``[S, *B, n, A]``, of the S transitions that the sampler adds noise to; default: drawn. Likewise.

        Returns:
            actions ``[*B, n, A]``; with ``ego`` those of the first robots, ``[*B, A]``.

        Raises:
            ValueError: if a shape does not fit the policy, or the observation is not finite.
        """
        observation = np.asarray(observation, np.float32)
        if observation.ndim < 2 or observation.shape[-1] != self.width or observation.shape[-2] < 1:
            expected = f"[*B, n, {self.width}] with n of at least 1"
            raise ValueError(f"{self._input}: got shape {list(observation.shape)}, expected {expected}")
        if not np.isfinite(observation).all():
            raise ValueError(f"{self._input}: got values that are not finite")
        *batch, n, width = observation.shape
        robots = batch if self.ego else [*batch, n]
        feed = {self._input: observation.reshape(-1, n, width)}
        for name, value in (("latent", latent), ("noise", noise)):
            if name in self._steps:
                drawn = self._drawn(name, value, [*self._steps[name], *robots, self._action_dim])
                feed[name] = drawn.reshape(*self._steps[name], -1, *robots[len(batch) :], self._action_dim)
            elif value is not None:
                raise ValueError(f"{name}: this policy takes none; export it with stochastic=True and a noisy sampler")
        (action,) = self._session.run(None, feed)
        return action.reshape(*robots, self._action_dim)

    def _drawn(self, name: str, value: ArrayLike | None, shape: list[int]) -> NDArray[np.float32]:
        if value is None:
            return self._generator.standard_normal(shape, np.float32)
        value = np.asarray(value, np.float32)
        if list(value.shape) != shape:
            raise ValueError(f"{name}: got shape {list(value.shape)}, expected {shape} to go with the {self._input}'s")
        return value


def load_policy(path: str | Path, *, threads: int = 1, seed: int | None = None) -> ExportedPolicy:
    """A ready policy from a file of :func:`~redig.deploy.export_policy`; nothing in the file is executed as code.

    Args:
        path: of the file.
        threads: of ONNX Runtime; networks of this size gain nothing from a second one.
        seed: of what a stochastic policy draws; ``None``: another one each time.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: for ``threads`` below 1; if it is not such a file, is damaged, or has weights in other files or
            operators of someone's own.

    Examples:
        >>> load_policy("no/such/policy.onnx")
        Traceback (most recent call last):
        ...
        FileNotFoundError: policy: no such file: no/such/policy.onnx
    """
    if threads < 1:
        raise ValueError(f"threads: got {threads}, must be at least 1")
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"policy: no such file: {path}")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4  # what it has to say is in the exception
    # weights in other files are looked for in this folder, which is none: a policy is one file, and reads no other
    options.add_session_config_entry("session.model_external_initializers_file_folder_path", str(path))
    try:
        session = onnxruntime.InferenceSession(path.read_bytes(), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # one class for each kind of damage, without a base of their own
        raise ValueError(f"policy: {path} is not an ONNX file, or is damaged ({error})") from error
    header = session.get_modelmeta().custom_metadata_map
    if header.get("format") != FORMAT:
        raise ValueError(f"policy: {path} has format {header.get('format')!r}, expected {FORMAT!r}")
    try:
        return ExportedPolicy(
            session, {key: json.loads(header[key]) for key in ("policy", "environment", "sampler")}, seed
        )
    except (KeyError, IndexError, TypeError, ValueError) as error:
        raise ValueError(f"policy: the header of {path} is damaged, or of another version ({error})") from error
