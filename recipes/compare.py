"""One learning curve of the comparison with TorchRL's own algorithms.

``python recipes/compare.py --task pendulum --method sac --seed 0`` writes ``runs/compare/pendulum-sac-seed0.csv`` and
its configuration beside it; ``recipes/compare_plot.py`` draws what such files hold.
"""

from __future__ import annotations

import json
import math
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from statistics import fmean

import torch
import tyro
from compare_methods import METHODS, TUNED
from compare_tasks import BUDGETS, Config, Keys, make_env, transitions
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import EnvBase
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.envs.seeding import preserve_rng_state
from redig.files import replacing, write_csv

EVALUATION_SEED = 10_000  # the same starts for all methods and seeds; far from the seeds of training
COLUMNS = ("frames", "updates", "return_mean", "return_sd", "seconds", "loss_qvalue", "loss_actor")


@dataclass
class Arguments:
    """Train one method on one task, and evaluate it along the way."""

    task: str
    """pendulum, navigation or reverse_transport."""
    method: str
    """pendulum: sac, td3, dipo, dipo_paper, qvpo, dpmd; teams: iddpg, maddpg, masac, dipo, qvpo, dpmd."""
    seed: int = 0
    """Seed of networks, exploration and training starts."""
    out: Path = Path("runs/compare")
    """Folder for TASK-METHOD-seedSEED.csv and .json."""
    change: dict[str, float] = field(default_factory=dict)
    """Options of compare_tasks.Config to change, such as --change lr 1e-3 frames 20000."""
    threads: int = 1
    """Threads of PyTorch."""

    def config(self) -> Config:
        """All options of the run.

        Raises:
            ValueError: for an unknown task, method or option.
        """
        if self.task not in METHODS:
            raise ValueError(f"task: got {self.task!r}, allowed are {', '.join(METHODS)}")
        if self.method not in METHODS[self.task]:
            allowed = ", ".join(METHODS[self.task])
            raise ValueError(f"method: got {self.method!r}, allowed on {self.task} are {allowed}")
        config = Config(self.task, self.method, self.seed, **BUDGETS[self.task])
        numbers = {name: value for name, value in asdict(config).items() if not isinstance(value, str)}
        changed = {**TUNED[self.task].get(self.method, {}), **self.change}
        for name in changed:
            if name not in numbers:
                raise ValueError(f"change: got {name!r}, allowed are {', '.join(numbers)}")
        return replace(config, **{name: type(numbers[name])(value) for name, value in changed.items()})


def main(arguments: Arguments) -> Path:
    """Run what the command line asks for; returns the path of the CSV file."""
    torch.set_num_threads(arguments.threads)
    config = arguments.config()
    path = arguments.out / f"{config.task}-{config.method}-seed{config.seed}.csv"
    with replacing(path.with_suffix(".json")) as file:
        file.write_text(json.dumps(asdict(config), indent=2) + "\n")
    rows = train(config)
    write_csv(path, rows, COLUMNS)
    return path


def train(config: Config) -> list[dict[str, float]]:
    """Collect, update and evaluate until the frames are spent; returns one row an evaluation."""
    torch.manual_seed(config.seed)
    test_env = make_env(config.task, config.episodes, config.episode_steps, EVALUATION_SEED)
    env = make_env(config.task, config.num_envs, config.episode_steps, config.seed)
    torch.manual_seed(config.seed)  # building environments draws random numbers
    keys, method = Keys.of(env), METHODS[config.task][config.method](env, config)
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(config.frames), batch_size=config.batch_size)
    collector = Collector(
        env,
        method.collect,
        frames_per_batch=config.frames_per_batch,
        total_frames=config.frames,
        init_random_frames=config.random_frames,
        auto_register_policy_transforms=False,
    )
    rows: list[dict[str, float]] = []
    losses: list[dict[str, float]] = []
    frames, updates, seconds = 0, 0, 0.0

    def evaluation() -> None:
        returns = evaluate(test_env, method.evaluate, config.episode_steps)
        means = [fmean(loss[name] for loss in losses) if losses else math.nan for name in COLUMNS[-2:]]
        figures = (frames, updates, returns.mean().item(), returns.std().item(), round(seconds, 1), *means)
        rows.append(dict(zip(COLUMNS, figures, strict=True)))
        losses.clear()
        print(", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)

    evaluation()
    started = time.perf_counter()
    for data in collector:
        frames += data.numel()
        collected = transitions(data, keys)
        if method.improved is not None:
            collected[method.improved] = collected[keys.action].clone()
        buffer.extend(collected)
        method.explored(data.numel())
        if frames > config.random_frames:
            for _ in range(config.updates_per_batch):
                batch = buffer.sample()
                losses.append({name: value.item() for name, value in method.update(batch).items()})
                if method.improved is not None:
                    buffer.set_at_(method.improved, batch[method.improved], batch["index"])
            updates += config.updates_per_batch
        if frames % config.evaluation_frames < data.numel() or frames >= config.frames:
            seconds += time.perf_counter() - started
            evaluation()
            started = time.perf_counter()
    collector.shutdown()
    test_env.close()
    return rows


def evaluate(env: EnvBase, policy: TensorDictModuleBase, steps: int) -> Tensor:
    """Returns ``[episodes]`` of the deterministic policy from fixed starts: summed over steps, mean over agents."""
    with preserve_rng_state(), torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        env.set_seed(EVALUATION_SEED)
        data = env.rollout(steps, policy, break_when_any_done=False)
    done = data["next", "done"].flatten(2).any(-1).int()  # [episodes, steps]
    first_episode = done.cumsum(1) - done == 0  # environments that are done start again
    reward = data["next", env.reward_key].flatten(2).mean(-1)
    return (reward * first_episode).sum(1)


if __name__ == "__main__":
    main(tyro.cli(Arguments))
