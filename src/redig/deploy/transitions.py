"""A sampler's chain as factors, one row a step: what is left of it where the loop is written out."""

from __future__ import annotations

import math
from typing import NamedTuple

from redig.modules import NoiseSchedule, Sampler


class Transition(NamedTuple):
    """Factors of one step: of the action and the predicted noise in the estimate of ``a^0``, then those of the sampler.

    At the last step, those of the sampler are 1 for the estimate and 0 for the rest.

    Examples:
        >>> last = Transition(step=19, of_action=1.1, of_predicted=-0.4)
        >>> last.c0, last.sigma
        (1.0, 0.0)
    """

    step: int
    of_action: float
    of_predicted: float
    c0: float = 1.0
    ck: float = 0.0
    c_older: float = 0.0
    sigma: float = 0.0


def chain_transitions(sampler: Sampler, schedule: NoiseSchedule, deterministic: bool) -> list[Transition]:
    """All steps of a sampler, noisiest first.

    Args:
        sampler: made of :meth:`~redig.modules.Sampler.coefficients`.
        schedule: that the denoiser was trained with.
        deterministic: without noise, whatever the sampler's options say.

    Raises:
        ValueError: if the sampler has a loop of its own.

    Examples:
        >>> from redig.modules import DDPM
        >>> chain = chain_transitions(DDPM(num_steps=5), NoiseSchedule(100), deterministic=True)
        >>> [transition.step for transition in chain], chain[-1].c0
        ([99, 79, 59, 39, 19], 1.0)
    """
    if type(sampler).__call__ is not Sampler.__call__:
        raise ValueError(f"sampler: {sampler} has a loop of its own; only its coefficients can be exported")
    steps = sampler.timesteps(schedule)
    transitions, older = [], None
    for step, previous in zip(steps, [*steps[1:], None], strict=True):
        signal = schedule.signal(step)
        estimate = 1 / math.sqrt(signal), -math.sqrt(1 / signal - 1)
        following = () if previous is None else sampler.coefficients(schedule, step, previous, older, deterministic)
        transition = Transition(step, *estimate, *following)
        transitions.append(transition._replace(sigma=0.0) if deterministic else transition)
        older = step
    return transitions
