"""TorchRL's own algorithms, with the networks and hyperparameters of its recipes (``sota-implementations`` in its
repository: ``sac``, ``td3``, ``multiagent/sac.py``, ``multiagent/maddpg_iddpg.py``).

What differs from those recipes is in :mod:`compare_tasks`, the same for all methods: smaller batches and fewer frames,
all of them kept in the replay buffer, and learning rates tuned for that budget.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from compare_tasks import Config, Keys
from tensordict import TensorDictBase
from tensordict.nn import NormalParamExtractor, TensorDictModule, TensorDictModuleBase, TensorDictSequential
from torch import Tensor, nn
from torchrl.data import TensorSpec
from torchrl.envs import EnvBase
from torchrl.modules import (
    MLP,
    AdditiveGaussianModule,
    MultiAgentMLP,
    ProbabilisticActor,
    TanhDelta,
    TanhModule,
    TanhNormal,
    ValueOperator,
)
from torchrl.objectives import DDPGLoss, LossModule, SACLoss, SoftUpdate, TD3Loss

SAC_GRAD_NORM, DDPG_GRAD_NORM = 2.0, 40.0  # limits of the multi-agent recipes; the single-agent ones have none


@dataclass
class Method:
    """What the comparison needs of an algorithm.

    Attributes:
        collect: policy that explores.
        evaluate: policy that is evaluated, with ``ExplorationType.DETERMINISTIC``.
        update: one update of all networks from a batch of transitions, see :func:`compare_tasks.transitions`; returns
            ``loss_qvalue`` and ``loss_actor``.
        explored: called with the number of frames after each collection, to anneal exploration.
        improved: key of a copy of the action that updates improve and that the replay buffer keeps.
    """

    collect: TensorDictModuleBase
    evaluate: TensorDictModuleBase
    update: Callable[[TensorDictBase], dict[str, Tensor]]
    explored: Callable[[int], object] = lambda frames: None
    improved: str | None = None


def make_sac(env: EnvBase, config: Config, centralised: bool = True) -> Method:
    """SAC; of a team MASAC, or ISAC with ``centralised=False``."""
    keys, spec, team = Keys.of(env), action_spec(env), is_team(env)
    extractor = NormalParamExtractor() if team else NormalParamExtractor(scale_lb=0.1)
    actor = ProbabilisticActor(
        TensorDictModule(
            nn.Sequential(network(env, config, observation_dim(env), 2 * spec.shape[-1]), extractor),
            in_keys=[keys.observation],
            out_keys=[parameter(keys, "loc"), parameter(keys, "scale")],
        ),
        spec=env.full_action_spec_unbatched,
        in_keys={"loc": parameter(keys, "loc"), "scale": parameter(keys, "scale")},
        out_keys=[keys.action],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
        return_log_prob=False,
    )
    loss = SACLoss(
        actor,
        critic(env, config, centralised),
        loss_function="smooth_l1" if team else "l2",
        alpha_init=config.alpha_init,
        action_spec=env.full_action_spec_unbatched,
    )
    set_keys(loss, keys, config)
    step = Step(loss, config, SAC_GRAD_NORM if team else None)

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        losses = loss(batch)
        step(losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"])
        return {"loss_qvalue": losses["loss_qvalue"], "loss_actor": losses["loss_actor"]}

    return Method(actor, actor, update)


def make_td3(env: EnvBase, config: Config) -> Method:
    """TD3. Its noise, given for actions in [-1, 1], is scaled to the bounds of the environment."""
    keys, spec = Keys.of(env), action_spec(env)
    scale = spec.space.high.max().item()
    actor = TensorDictSequential(
        TensorDictModule(network(env, config, observation_dim(env), spec.shape[-1]), [keys.observation], ["param"]),
        TanhModule(in_keys=["param"], out_keys=[keys.action], spec=spec),
    )
    noise = AdditiveGaussianModule(spec, sigma_init=1.0, sigma_end=1.0, std=0.1 * scale, action_key=keys.action)
    loss = TD3Loss(
        actor,
        critic(env, config, centralised=False),
        action_spec=spec,
        policy_noise=0.2 * scale,
        noise_clip=0.5 * scale,
        loss_function="l2",
    )
    set_keys(loss, keys, config)
    step = Step(loss, config)

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        loss_qvalue, _ = loss.value_loss(batch)
        loss_actor, _ = loss.actor_loss(batch)
        delayed = step.count % 2 == 0  # actor and targets move at every second update
        step(loss_qvalue if delayed else loss_qvalue + loss_actor, targets=not delayed)
        return {"loss_qvalue": loss_qvalue, "loss_actor": loss_actor}

    return Method(TensorDictSequential(actor, noise), actor, update)


def make_ddpg(env: EnvBase, config: Config, centralised: bool) -> Method:
    """MADDPG, or IDDPG with ``centralised=False``; parameters are shared between agents."""
    keys, spec = Keys.of(env), action_spec(env)
    param = parameter(keys, "param")
    actor = ProbabilisticActor(
        TensorDictModule(network(env, config, observation_dim(env), spec.shape[-1]), [keys.observation], [param]),
        spec=env.full_action_spec_unbatched,
        in_keys={"param": param},
        out_keys=[keys.action],
        distribution_class=TanhDelta,
        distribution_kwargs={"low": spec.space.low, "high": spec.space.high},
    )
    noise = AdditiveGaussianModule(
        env.full_action_spec_unbatched, annealing_num_steps=config.frames // 2, action_key=keys.action
    )
    loss = DDPGLoss(actor, critic(env, config, centralised), delay_value=True)
    set_keys(loss, keys, config)
    step = Step(loss, config, DDPG_GRAD_NORM)

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        losses = loss(batch)
        step(losses["loss_actor"] + losses["loss_value"])
        return {"loss_qvalue": losses["loss_value"], "loss_actor": losses["loss_actor"]}

    return Method(TensorDictSequential(actor, noise), actor, update, explored=noise.step)


class Step:
    """Clip the gradient of a loss, step Adam, and move the targets."""

    def __init__(self, loss: LossModule, config: Config, grad_norm: float | None = None) -> None:
        self.parameters = list(loss.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, config.lr, fused=True)
        self.target = SoftUpdate(loss, tau=config.tau)
        self.grad_norm = grad_norm
        self.count = 0

    def __call__(self, loss: Tensor, targets: bool = True) -> None:
        """One step down the gradient of ``loss``; parameters that it does not reach stay."""
        self.optimizer.zero_grad()
        loss.backward()
        if self.grad_norm is not None:
            torch.nn.utils.clip_grad_norm_(self.parameters, self.grad_norm)
        self.optimizer.step()
        if targets:
            self.target.step()
        self.count += 1


def critic(env: EnvBase, config: Config, centralised: bool) -> TensorDictModule:
    """Q of observation and action: of each agent's own, or, centralised, of the whole team's."""
    keys, inputs = Keys.of(env), observation_dim(env) + action_spec(env).shape[-1]
    module = network(env, config, inputs, 1, centralised)
    return ValueOperator(module, in_keys=[keys.observation, keys.action], out_keys=[keys.state_action_value])


def network(env: EnvBase, config: Config, inputs: int, outputs: int, centralised: bool = False) -> nn.Module:
    """Two hidden layers: Tanh for each agent of a team with shared parameters, ReLU for a single agent, as theirs."""
    if not is_team(env):
        return MLP(inputs, outputs, num_cells=[config.hidden] * 2, activation_class=nn.ReLU)
    return MultiAgentMLP(
        inputs,
        outputs,
        action_spec(env).shape[0],
        centralised=centralised,
        share_params=True,
        depth=2,
        num_cells=config.hidden,
        activation_class=nn.Tanh,
    )


def set_keys(loss: LossModule, keys: Keys, config: Config) -> None:
    """Tell a loss where things are, and the discount."""
    names = ("action", "reward", "done", "terminated", "state_action_value")
    accepted = {name: getattr(keys, name) for name in names if hasattr(loss.default_keys, name)}
    loss.set_keys(**accepted)
    loss.make_value_estimator(gamma=config.gamma)


def is_team(env: EnvBase) -> bool:
    """Whether several agents act."""
    return isinstance(env.action_key, tuple)


def parameter(keys: Keys, name: str) -> str | tuple[str, ...]:
    """Key of a distribution's parameter, beside the action."""
    return (*keys.action[:-1], name) if isinstance(keys.action, tuple) else name


def action_spec(env: EnvBase) -> TensorSpec:
    """Spec of the action, without the dimension of parallel environments: ``[A]`` or ``[n, A]``."""
    return env.full_action_spec_unbatched[Keys.of(env).action]


def observation_dim(env: EnvBase) -> int:
    """Width of an agent's observation."""
    return env.observation_spec[Keys.of(env).observation].shape[-1]
