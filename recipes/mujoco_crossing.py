"""A trained team in MuJoCo, beside the simulator that it was trained in: ``python recipes/mujoco_crossing.py``."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import mujoco
import tyro
from evaluate import draw_crossing
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor

from redig.deploy.drive import LIMO
from redig.envs.factory import make_env
from redig.evaluation import rollout_trajectories, team_metrics
from redig.files import write_csv
from redig.pace import Paced
from redig.physics import Ground, PhysicsNavigation, RobotBody
from redig.policy import load_policy, read_header
from redig.viz.animation import write_film

SHOWN = (
    "success_rate", "team_success_rate", "travel_time", "cfi_0.5", "cfi_0.1", "cfi_0.03", "jerk_mean", "collision_rate",
)  # fmt: skip
CASES = (
    "VMAS", "MuJoCo", "limo", "slow turns", "weak motors", "grip 0.2", "grip 0.1", "grip 0.05", "ridge 0.1 m",
    "VMAS, 0.2 s late", "0.2 s late", "VMAS, noise 0.05", "noise 0.05",
)  # fmt: skip


@dataclass
class Arguments:
    """Drive differential-drive robots in MuJoCo with a policy, unmodified, and compare with VMAS on the same starts."""

    policy: Path = Path("recipes/policies/wedge.safetensors")
    """Policy file; its formation and map are those of its training."""
    starts: int = 50
    """Number of starts of each case."""
    seed: int = 2_000_000
    """Seed of the starts; those of training and validation are others."""
    cases: tuple[str, ...] = CASES
    """What to compare: names as in the table."""
    pace: float = 1.0
    """Drive in slow motion: 0.5 takes twice the time (redig.pace.Paced)."""
    out: Path = Path("runs/mujoco")
    """Folder of FORMATION.csv and the pictures."""
    film: Literal["render", "plan", "none"] = "plan"
    """render: filmed by MuJoCo, which needs OpenGL (without a screen: MUJOCO_GL=egl); plan: drawn from above."""


def case(name: str, scenario: dict[str, Any], starts: int, pace: float = 1.0) -> Any:
    """The environment of a case, for a policy at a pace: where it is, and what is different there.

    Raises:
        ValueError: for an unknown name.
    """
    if name not in CASES:
        raise ValueError(f"cases: got {name!r}, allowed are {', '.join(CASES)}")
    body = RobotBody()
    limo = replace(LIMO, track=body.track, wheel_radius=body.wheel_radius)  # 1 rad/s; gain as of redig-robot
    changes: dict[str, dict[str, Any]] = {
        "limo": {"base": limo, "gain": 4.0},
        "slow turns": {"gain": 2.0},
        "weak motors": {"body": RobotBody(torque=0.04)},  # 1 m/s²
        "0.2 s late": {"action_delay": (2, 2)},
        "noise 0.05": {"observation_noise": 0.05},
        "ridge 0.1 m": {"ground": Ground(ridge_height=0.1, ridge_angle=scenario.get("corridor_angle", 0.0))},
        **{f"grip {mu}": {"ground": Ground(friction=mu)} for mu in (0.2, 0.1, 0.05)},
    }
    change = changes.get(name.removeprefix("VMAS, "), {})
    paced = scenario | {"max_speed": pace * scenario.get("max_speed", 1.0)}
    if name.startswith("VMAS"):
        return make_env(starts, **paced, **change)
    return make_env(starts, scenario=PhysicsNavigation(), pace=pace, **paced, **change)


def tracking(trajectories: TensorDictBase) -> dict[str, Tensor]:
    """How far velocities are from the commands of the step before, until a robot's arrival, for each team ``[E]``.

    Root mean squares along and across the command (m/s), and ``response``: the share of the difference between
    velocity and command that is gone at the end of a step, by least squares.
    """
    command, velocity = trajectories["command"][:, 1:], trajectories["velocity"]
    before, after = velocity[:, :-1], velocity[:, 1:]
    counted = ~trajectories["arrived"][:, :-1] & trajectories["mask"][:, 1:, None]
    ahead = command / command.norm(dim=-1, keepdim=True).clamp_min(1e-6)
    error = after - command
    along = (error * ahead).sum(-1)
    across = error[..., 1] * ahead[..., 0] - error[..., 0] * ahead[..., 1]

    def total(value: Tensor) -> Tensor:
        return (value * counted).sum((-2, -1))

    asked = total((command - before).square().sum(-1))
    return {
        "error_along": (total(along.square()) / counted.sum((-2, -1))).sqrt(),
        "error_across": (total(across.square()) / counted.sum((-2, -1))).sqrt(),
        "response": total(((after - before) * (command - before)).sum(-1)) / asked,
    }


def measure(policy: TensorDictModuleBase, env: Any, seed: int) -> dict[str, float]:
    """Mean and standard deviation over starts of all metrics, and how much faster than real time this was."""
    started = time.process_time()
    trajectories = rollout_trajectories(policy, env, seed)
    driven = trajectories["mask"].sum().item() * env.scenario.dt  # s, of all teams together
    factor = driven / (time.process_time() - started)
    figures: dict[str, float] = {}
    for key, value in {**team_metrics(trajectories, env.scenario), **tracking(trajectories)}.items():
        known = value[~value.isnan()].double()
        figures[key] = known.mean().item()
        figures[f"{key}_sd"] = known.std(correction=0).item() if len(known) else float("nan")
    return {**figures, "times_real_time": factor}


def film(path: Path, policy: TensorDictModuleBase, env: Any, seed: int) -> None:
    """One crossing, filmed by MuJoCo in real time."""
    team = env.scenario.teams[0]
    camera = mujoco.MjvCamera()
    camera.lookat[:], camera.distance, camera.azimuth, camera.elevation = (0.0, 0.0, 0.0), 5.6, 90.0, -50.0
    renderer = team.renderer(960, 544)
    frames: list[Any] = []

    def shoot(*_: object) -> None:
        renderer.update_scene(team.data, camera)
        frames.append(renderer.render())

    hook = policy.register_forward_pre_hook(shoot)
    rollout_trajectories(policy, env, seed)
    hook.remove()
    renderer.close()
    write_film(path, frames, round(1 / env.scenario.dt))


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Measure every case, print and write the table, draw one crossing."""
    _, scenario = read_header(arguments.policy)
    formation = scenario["formation"]
    rows: list[dict[str, Any]] = []
    for name in arguments.cases:
        env = case(name, scenario, arguments.starts, arguments.pace)
        trained = load_policy(arguments.policy, env.observation_spec["agents", "observation"].shape[-1])
        policy = Paced(trained, arguments.pace)
        figures = measure(policy, env, arguments.seed)
        what = {"case": name, "pace": arguments.pace, "starts": arguments.starts, "seed": arguments.seed}
        rows.append(what | figures)
        print(f"{name:22}" + ", ".join(f"{key} {figures[key]:.3f}" for key in SHOWN), flush=True)
    arguments.out.mkdir(parents=True, exist_ok=True)
    shown = [{k: f"{v:.6g}" if isinstance(v, float) else v for k, v in row.items()} for row in rows]
    write_csv(arguments.out / f"{formation}.csv", shown)
    if arguments.film != "none":
        env = case("MuJoCo", scenario, 1, arguments.pace)
        if arguments.film == "render":
            film(arguments.out / f"{formation}.mp4", policy, env, arguments.seed)
        else:
            draw_crossing(arguments.out, policy, env, arguments.seed, f"{formation}.mp4")
    print(f"written to {arguments.out}")
    return rows


if __name__ == "__main__":
    main(tyro.cli(Arguments))
