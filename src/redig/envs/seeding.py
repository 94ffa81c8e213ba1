"""Random numbers of an environment, apart from those of its caller."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import torch
from vmas.simulator.environment.environment import Environment


@contextmanager
def preserve_rng_state() -> Iterator[None]:
    """Leave torch's global generator and that of VMAS as they were, whatever happens inside the block.

    VMAS keeps one random state for all its environments, so seeding an evaluation would otherwise also change what a
    training environment draws next.

    Examples:
        >>> import torch
        >>> expected = torch.manual_seed(0) and torch.rand(1)
        >>> _ = torch.manual_seed(0)
        >>> with preserve_rng_state():
        ...     _ = torch.manual_seed(7)
        >>> torch.equal(torch.rand(1), expected)
        True
    """
    vmas_state = Environment.vmas_random_state
    saved = list(vmas_state)
    try:
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            yield
    finally:
        vmas_state[:] = saved  # in place: VMAS holds on to this very list
