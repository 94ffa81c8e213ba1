"""Collection on a Ray cluster that goes on when it loses workers.

TorchRL's ``RayCollector`` (0.14.1) does not. Its iterator raises Ray's ``ActorDiedError``, or a ``RuntimeError`` of
gloo where weights are sent to a worker that is gone; by then it has stopped the other workers too, and it yields
nothing afterwards. Ray's own ``max_restarts`` does not help: the process group for weights takes no new member.
"""

from __future__ import annotations

import sys
import threading
import warnings
from collections.abc import Callable, Iterator
from functools import partial
from typing import TYPE_CHECKING, Any

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType

if TYPE_CHECKING:
    from torchrl.collectors.distributed import RayCollector


class RayCollection(Iterator[TensorDictBase]):
    """An endless iterator over batches ``[workers, envs of a worker, num_steps]`` of experience.

    A batch is collected with the weights (and buffers) that the policy has when it is asked for. If workers are lost,
    the batch is thrown away, all workers are started again, with other seeds and in new episodes, and the batch is
    collected anew: there are fewer workers then if the cluster has fewer CPUs left. Policy, optimiser and replay buffer
    are the caller's, so nothing that was learned is lost.

    Args:
        env_maker: makes a vectorised environment from ``num_envs`` and ``seed``; workers unpickle it, so whatever it
            refers to must be installed on their machines.
        policy: acts in the workers; it has parameters.
        num_envs: environments of all workers together.
        num_steps: of each environment in a batch.
        num_workers: workers, one CPU each; they share ``num_envs`` equally.
        address: of a running cluster, as ``ray.init`` takes it (``HOST:PORT``, ``auto``), or ``local`` for a new one on
            this machine.
        seed: of environments and random actions, other for each worker.
        postproc: applied here to each batch, for example :class:`~redig.objectives.MultiStep`.

    Raises:
        ImportError: if Ray is missing; the message names the extra to install.
        ValueError: if ``num_workers`` is less than 1 or does not divide ``num_envs``.
        ConnectionError: from Ray, if there is no cluster at the address.
        TimeoutError: from ``next``, if workers did not start within ``START_TIMEOUT`` seconds, ``ATTEMPTS`` times.

    Examples:
        >>> from redig.envs import make_env
        >>> RayCollection(make_env, None, num_envs=8, num_steps=5, num_workers=3, address="local", seed=0)
        Traceback (most recent call last):
        ...
        ValueError: num_workers: got 3, must be at least 1 and divide num_envs = 8
    """

    ATTEMPTS = 3  # without a batch in between, before a loss of workers is an error
    START_TIMEOUT = (
        180.0  # s for workers to start and connect: RayCollector itself may wait for ever for one that idles
    )

    def __init__(
        self,
        env_maker: Callable[..., EnvBase],
        policy: TensorDictModuleBase,
        *,
        num_envs: int,
        num_steps: int,
        num_workers: int,
        address: str,
        seed: int,
        postproc: Callable[[TensorDictBase], TensorDictBase] | None = None,
    ) -> None:
        if num_workers < 1 or num_envs % num_workers:
            raise ValueError(f"num_workers: got {num_workers}, must be at least 1 and divide num_envs = {num_envs}")
        try:
            import ray
        except ImportError as error:
            raise ImportError("collection on a cluster needs ray; install it with: pip install 'redig[ray]'") from error
        self.env_maker, self.policy, self.postproc = env_maker, policy, postproc
        self.num_envs, self.num_steps, self.num_workers, self.seed = num_envs, num_steps, num_workers, seed
        self.restarts = 0
        self.address = address
        if not ray.is_initialized():  # here, because RayCollector would end a cluster that it has started itself
            self._connect()
        self.collector: RayCollector | None = None  # from the first batch on

    def __next__(self) -> TensorDictBase:
        """A batch; workers that are lost meanwhile are replaced first."""
        import ray
        from ray.exceptions import RayActorError, RayTaskError

        for attempt in range(self.ATTEMPTS):
            try:
                if self.collector is None:
                    self.collector = self._started_in_time()
                    self._batches = iter(self.collector)
                return next(self._batches)
            except RayTaskError:  # the environment or the policy has raised it: a new worker would do the same
                raise
            except (RayActorError, RuntimeError, TimeoutError) as error:  # RuntimeError: weights could not be sent
                if attempt + 1 == self.ATTEMPTS:
                    raise
                warnings.warn(f"lost a worker, all are started again: {error}", stacklevel=2)
                self.shutdown()
                if isinstance(error, TimeoutError):  # with the connection end the workers that do not answer
                    ray.shutdown()
                    self._connect()
                self.restarts += 1
        raise AssertionError("unreachable")

    def shutdown(self) -> None:
        """Stop the workers; the connection to the cluster stays."""
        if self.collector is not None:
            self.collector.shutdown()
            self.collector = None

    def _connect(self) -> None:
        import ray

        local: dict[str, Any] = (
            {"num_cpus": self.num_workers, "include_dashboard": False} if self.address == "local" else {}
        )
        ray.init(self.address, log_to_driver=False, **local)

    def _started_in_time(self) -> RayCollector:
        """Workers, started beside the main thread, which can give up on them."""
        outcome: list[RayCollector | BaseException] = []

        def start() -> None:
            try:
                outcome.append(self._start())
            except BaseException as error:
                outcome.append(error)

        thread = threading.Thread(target=start, name="start of Ray workers", daemon=True)
        thread.start()
        thread.join(self.START_TIMEOUT)
        if not outcome:
            raise TimeoutError(f"workers did not start within {self.START_TIMEOUT:g} s")
        if isinstance(outcome[0], BaseException):
            raise outcome[0]
        return outcome[0]

    def _start(self) -> RayCollector:
        import ray
        from torchrl.collectors.distributed import RayCollector

        cpus = int(ray.cluster_resources().get("CPU", 0))
        workers = max(w for w in range(1, self.num_workers + 1) if self.num_envs % w == 0 and w <= max(cpus, 1))
        # a seed for each worker of each start, from a sequence of their own
        seeds = torch.randint(
            2**31, (workers,), generator=torch.Generator().manual_seed(self.seed + 10_007 * self.restarts)
        )
        makers = [partial(_seeded, self.env_maker, self.num_envs // workers, int(seed)) for seed in seeds]
        collector = RayCollector(
            makers,
            self.policy,
            frames_per_batch=self.num_envs * self.num_steps,
            total_frames=2**62,  # -1, which means endless elsewhere, yields nothing
            sync=True,
            update_after_each_batch=True,
            postproc=self.postproc,
            exploration_type=ExplorationType.RANDOM,
            collector_class=_Worker,
            collector_kwargs=[{"auto_register_policy_transforms": False} for _ in makers],
            remote_configs={"num_cpus": 1},
        )
        collector.update_policy_weights_()  # connects; after that, before each batch
        return collector


class _Worker(Collector):
    """A collector whose errors reach the caller: Ray asks for the length, and dies of TorchRL's infinite one."""

    def __len__(self) -> int:
        return sys.maxsize


def _seeded(env_maker: Callable[..., EnvBase], num_envs: int, seed: int) -> EnvBase:
    """The environment of a worker, whose random actions are seeded too: else all workers draw the same."""
    torch.set_num_threads(1)
    torch.manual_seed(seed)
    return env_maker(num_envs=num_envs, seed=seed)
