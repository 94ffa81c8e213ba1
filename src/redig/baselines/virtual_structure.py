"""Virtual structure: the ceiling. One planner for the whole team, and each robot tracks its slot."""

from __future__ import annotations

from torch import Tensor

from redig.baselines.episode import EpisodePlanner
from redig.envs.navigation import FormationNavigation
from redig.planning.plans import team_structures
from redig.planning.tracking import ReferenceTracker, pad_references


class VirtualStructure(EpisodePlanner):
    """Each robot tracks its slot in a formation that is squeezed to fit the map ahead and restored after it.

    The plan is :class:`~redig.planning.virtual_structure.StructurePlanner`'s: centralised, with the map and all goals
    known. It shows which travel time, formation integrity and jerk are possible.

    Args:
        scenario: of the environment to drive.
        max_speed: of a robot (m/s); default: the scenario's.
        options: of :class:`~redig.planning.virtual_structure.StructurePlanner`, such as ``clearance``.

    Raises:
        ValueError: if an argument is out of range.

    Examples:
        >>> from redig.envs import make_env
        >>> from redig.evaluation import evaluate
        >>> env = make_env(2)
        >>> evaluate(VirtualStructure(env.scenario), env, seed=0)["success_rate"]
        1.0
    """

    def __init__(self, scenario: FormationNavigation, max_speed: float | None = None, **options: float) -> None:
        super().__init__(scenario)
        self.max_speed = scenario.max_speed if max_speed is None else max_speed
        if not 0 < self.max_speed <= scenario.max_speed:
            raise ValueError(f"max_speed: got {max_speed}, must be greater than 0 and at most {scenario.max_speed} m/s")
        self.structure_of = team_structures(scenario, **options)
        self.structure_of(0)  # checks the options now rather than in an episode
        self._plans: list[Tensor] = []

    def begin(self, teams: Tensor, position: Tensor, goal: Tensor, num_teams: int) -> None:
        """Plan one passage for each team."""
        limits = (self.max_speed, self.scenario.max_acceleration, self.scenario.dt)
        if len(self._plans) != num_teams:
            self._plans = [position.new_empty(0)] * num_teams
        for team, start, end in zip(teams.tolist(), position.cpu(), goal.cpu(), strict=True):
            self._plans[team] = self.structure_of(team)(start, end, *limits)
        self._tracker = ReferenceTracker(pad_references(self._plans).to(position.device), self.scenario.dt)

    def command(self, position: Tensor, velocity: Tensor, step: Tensor) -> Tensor:
        """Follow the plan."""
        return self._tracker(position, step)
