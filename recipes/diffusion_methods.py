"""Our methods in the comparison with TorchRL's own, see :mod:`compare_methods`.

All but ``dipo_paper`` have the widths, batches and updates of the peers, five-step chains and, in a team, critics that
see one agent each.
"""

from __future__ import annotations

from dataclasses import replace

from compare_tasks import Config, Keys
from peers import Method, Step, action_spec, critic, observation_dim, set_keys
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModule
from torch import Tensor
from torchrl.envs import EnvBase

from redig import DDPM, DenoisingMLP, DiffusionActor, DIPOLoss, NoiseSchedule, QNetwork, QWeightedLoss
from redig.objectives import DiffusionActorCriticLoss

IMPROVED = "best_action"


def make_dipo(env: EnvBase, config: Config, centralised: bool = False) -> Method:
    """DIPO: a diffusion policy that learns stored actions, which the critics' gradient improves again and again."""
    actor = diffusion_actor(env, config)
    loss = DIPOLoss(
        None,
        actor,
        critic(env, config, centralised),
        refine_steps=5,
        refine_step_size=0.03,
        refine_optimizer="adam",
    )
    loss.set_keys(base_action=IMPROVED, refined_action=IMPROVED)
    return replace(method(loss, actor, env, config), improved=IMPROVED)


def make_dipo_paper(env: EnvBase, config: Config) -> Method:
    """DIPO with its authors' networks and hyperparameters: chains of 100 steps, improved actions kept in the buffer."""
    keys, spec = Keys.of(env), action_spec(env)
    size, state = spec.shape[-1], observation_dim(env)
    actor = DiffusionActor(
        DenoisingMLP(size, state, hidden=(256, 256, 256), step_dim=32),
        spec,
        [keys.observation],
        [keys.action],
        schedule=NoiseSchedule(100, "cosine"),
    )
    value = QNetwork(state, size, hidden=(256, 256, 256), layer_norm=False)
    loss = DIPOLoss(
        None,
        actor,
        TensorDictModule(value, [keys.observation, keys.action], [keys.state_action_value]),
        refine_steps=20,
        refine_step_size=0.03,
        refine_optimizer="adam",
        refine_grad_norm=0.1 * size,
    )
    loss.set_keys(base_action=IMPROVED, refined_action=IMPROVED)
    return replace(method(loss, actor, env, config, grad_norm=2.0), improved=IMPROVED)


def make_qvpo(env: EnvBase, config: Config, centralised: bool = False) -> Method:
    """QVPO: the best of the policy's own actions, weighted by their advantage."""
    actor = diffusion_actor(env, config)
    loss = QWeightedLoss(None, actor, critic(env, config, centralised), weighting="advantage", num_candidates=4)
    return method(loss, actor, env, config)


def make_dpmd(env: EnvBase, config: Config, centralised: bool = False) -> Method:
    """DPMD: the policy's own actions, weighted by the exponential of their value."""
    actor = diffusion_actor(env, config)
    loss = QWeightedLoss(
        None, actor, critic(env, config, centralised), weighting="exponential", num_candidates=4, temperature=0.3
    )
    return method(loss, actor, env, config)


def diffusion_actor(env: EnvBase, config: Config) -> DiffusionActor:
    """A diffusion policy on observations, with the widths of the peers' actors."""
    keys, spec = Keys.of(env), action_spec(env)
    denoiser = DenoisingMLP(spec.shape[-1], observation_dim(env), (config.hidden, config.hidden), activation="relu")
    return DiffusionActor(denoiser, spec, [keys.observation], [keys.action], sampler=DDPM(num_steps=5))


def method(
    loss: DiffusionActorCriticLoss, actor: DiffusionActor, env: EnvBase, config: Config, grad_norm: float | None = None
) -> Method:
    """One of our losses as a method: both losses in one step."""
    set_keys(loss, Keys.of(env), config)
    step = Step(loss, config, grad_norm)

    def update(batch: TensorDictBase) -> dict[str, Tensor]:
        losses = loss(batch)
        step(losses["loss_qvalue"] + losses["loss_actor"])
        return {"loss_qvalue": losses["loss_qvalue"], "loss_actor": losses["loss_actor"]}

    return Method(actor, actor, update)
