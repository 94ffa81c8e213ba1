"""One full update, ours beside the same written plainly and beside TorchRL's SAC: ``python benchmarks/update.py``.

A full update is the critic's (TD target with an action sampled from the target policy, Eq. 2), the refinement and the
actor's (Eq. 1), each with its optimiser step, and a step of the target networks, on 256 team states of five robots.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
import tyro
from harness import Timing, alternate, ratio, report
from plain import PlainCritic, PlainDenoiser, PlainEncoder, PlainUpdate
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import Tensor, nn
from torchrl.modules import MLP, NormalParamExtractor, ProbabilisticActor, TanhNormal
from torchrl.objectives import SACLoss, SoftUpdate

from redig.modules import GraphEncoder, NoiseSchedule, QNetwork
from redig.objectives import DIPOLoss
from redig.policy import ACTION, EMBEDDING, OBSERVATION, PolicyConfig, build_encoder, build_policy

VALUE, REWARD = ("agents", "state_action_value"), ("agents", "reward")
GAMMA, STEP_SIZE, MAX_NORM = 0.98, 0.3, 0.1
ACTIVATIONS = {"mish": nn.Mish, "silu": nn.SiLU}


@dataclass
class Arguments:
    """Time one full update."""

    teams: int = 256
    """Team states in a batch."""
    robots: int = 5
    """Robots in a team."""
    hidden: tuple[int, ...] = (256, 128)
    """Widths of the hidden layers: the paper's, and the recipe's."""
    diffusion_steps: int = 100
    """K."""
    block: int = 4
    """Updates whose targets and refined actions are computed at once, in one of the forms."""
    repeats: int = 7
    """Repetitions of each."""
    threads: int = 1
    """Threads."""
    out: Path = Path("docs/results/speed")
    """Folder for the tables."""


def main(arguments: Arguments) -> list[dict[str, Any]]:
    """Check that plain and ours agree, then time all forms in turn, then the parts of ours."""
    torch.set_num_threads(arguments.threads)
    rows, parts = [], []
    for hidden in arguments.hidden:
        torch.manual_seed(0)
        batch = make_batch(arguments.teams, arguments.robots)
        full = PolicyConfig(9, hidden=(hidden,) * 3, diffusion_steps=arguments.diffusion_steps, noise_ratio=0.0)
        few = replace(full, sampling_steps=min(5, arguments.diffusion_steps))
        plain, ours = pair(full)
        error = disagreement(plain, ours, batch)
        recipe = make_loss(few)
        calls = {
            "plain, K steps": plain_update(plain, batch),
            "ours, K steps": our_update(ours, batch, 1),
            "ours, 5 steps": our_update(recipe, batch, 1),
            f"ours, 5 steps, blocks of {arguments.block}": our_update(recipe, batch, arguments.block),
            "ours, 5 steps, SiLU": our_update(make_loss(replace(few, activation="silu")), batch, 1),
            "TorchRL SAC": sac_update(hidden, batch),
        }
        per_call = {name: arguments.block if "blocks" in name else 1 for name in calls}
        times = alternate(calls, arguments.repeats, seconds=0.0)
        times = {name: Timing(tuple(s / per_call[name] for s in t.seconds), t.first) for name, t in times.items()}
        for name, timing in times.items():
            rows.append(
                {
                    "hidden": hidden,
                    "update": name,
                    "ms": 1e3 * timing.median,
                    "plain / this": ratio(times["plain, K steps"], timing),
                    "this / SAC": ratio(timing, times["TorchRL SAC"]),
                    "first call (ms)": 1e3 * timing.first,
                    "difference to plain": error if name == "ours, K steps" else "",
                }
            )
        parts += [{"hidden": hidden, **row} for row in where_time_goes(recipe, batch, arguments.repeats)]
    notes = [
        f"Batch: {arguments.teams} teams of {arguments.robots} robots, K = {arguments.diffusion_steps}. *Difference*: "
        "the largest between the losses of plain and ours at K steps, on the same weights, batch and random numbers."
    ]
    report(arguments.out, "update", rows, notes)
    report(arguments.out, "update_parts", parts, ["Five steps, Mish, no blocks."])
    return rows


def make_batch(teams: int, robots: int) -> TensorDict:
    """Synthetic transitions with the keys of the recipe."""
    shape = (teams, robots)
    state = torch.randn(*shape, 9)
    no = torch.zeros(*shape, 1, dtype=torch.bool)
    following = {"observation": state + 0.1 * torch.randn_like(state), "reward": torch.randn(*shape, 1)}
    following |= {"done": no, "terminated": no}
    team = {"observation": state, "action": 2 * torch.rand(*shape, 2) - 1}
    return TensorDict({"agents": team, "next": {"agents": following}}, [teams])


def make_loss(config: PolicyConfig) -> DIPOLoss:
    """The recipe's loss: separate encoders, twin critics with LayerNorm and ReLU."""
    encoder, actor = build_policy(config)
    critic = QNetwork(config.embedding_dim, 2, config.hidden, layer_norm=True, activation="relu")
    qvalue = TensorDictModule(critic, [EMBEDDING, ACTION], [VALUE])
    loss = DIPOLoss(
        encoder,
        actor,
        qvalue,
        critic_encoder=build_encoder(config),
        refine_steps=1,
        refine_step_size=STEP_SIZE,
        refine_max_norm=MAX_NORM,
    )
    loss.set_keys(
        action=ACTION,
        reward=REWARD,
        state_action_value=VALUE,
        done=("agents", "done"),
        terminated=("agents", "terminated"),
        refined_action=("agents", "refined_action"),
        value_target=("agents", "value_target"),
        priority=("agents", "td_error"),
    )
    return loss.make_value_estimator(gamma=GAMMA)


def pair(config: PolicyConfig) -> tuple[PlainUpdate, DIPOLoss]:
    """The plain update and ours with the same weights."""
    loss = make_loss(config)
    hidden, activation = config.hidden[0], ACTIVATIONS[config.activation]
    encoder, critic_encoder = PlainEncoder(), PlainEncoder()
    denoiser, critics = PlainDenoiser(hidden, activation=activation), [PlainCritic(hidden) for _ in range(2)]
    for module, params in (
        (encoder, loss.encoder_network_params),
        (critic_encoder, loss.critic_encoder_network_params),
    ):
        source = GraphEncoder(9)
        source.load_state_dict(params["module"].flatten_keys(".").to_dict())
        copy_encoder(source, module)
    denoiser.load_state_dict(loss.actor_network_params["module", "denoiser"].flatten_keys(".").to_dict())
    for i, critic in enumerate(critics):
        critic.load_state_dict(loss.qvalue_network_params["module"].data[i].flatten_keys(".").to_dict())
    networks = (encoder, critic_encoder, denoiser, critics)
    alphas = NoiseSchedule(config.diffusion_steps, config.schedule).alphas_cumprod
    return PlainUpdate(*networks, copy.deepcopy(networks), alphas, GAMMA, STEP_SIZE, MAX_NORM), loss


def copy_encoder(source: GraphEncoder, to: PlainEncoder) -> None:
    """Weights of our encoder, whose first message layer is kept in three parts, into the plain one."""
    for name in ("lift", "message_out", "out"):
        getattr(to, name).load_state_dict(getattr(source, name).state_dict())
    weights = [source.message_self.weight, source.message_mate.weight, source.message_edge.weight]
    to.message_in.load_state_dict({"weight": torch.cat(weights, 1), "bias": source.message_self.bias})


def tensors(batch: TensorDictBase) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """State, action, reward, next state and whether the task has ended, ``[B, n, ...]``."""
    following = batch["next"]
    ended = following["agents", "terminated"].float()
    return batch[OBSERVATION], batch[ACTION], following[REWARD], following[OBSERVATION], ended


def disagreement(plain: PlainUpdate, loss: DIPOLoss, batch: TensorDictBase) -> float:
    """The largest difference between the losses of the plain form and ours, given the same random numbers."""
    state, action, *rest = tensors(batch)
    torch.manual_seed(1)
    expected = [plain.critic_loss(state, action, *rest), plain.actor_loss(state, action)]
    torch.manual_seed(1)
    data = batch.clone()
    found = [loss.qvalue_loss(data)[0], loss.actor_loss(data)[0]]
    return max((a - b).abs().item() for a, b in zip(expected, found, strict=True))


def plain_update(plain: PlainUpdate, batch: TensorDictBase) -> Callable[[], None]:
    """The plain form with Adam and one target parameter after the other."""
    state, action, *rest = tensors(batch)
    critic = nn.ModuleList([plain.critic_encoder, *plain.critics])
    actor = nn.ModuleList([plain.encoder, plain.denoiser])
    encoder, critic_encoder, denoiser, critics = plain.targets
    targets = nn.ModuleList([critic_encoder, *critics, encoder, denoiser])
    optimizers = [torch.optim.Adam(module.parameters(), 3e-4) for module in (critic, actor)]

    def update() -> None:
        step(plain.critic_loss(state, action, *rest), optimizers[0])
        step(plain.actor_loss(state, action), optimizers[1])
        with torch.no_grad():
            for target, source in zip(targets.parameters(), [*critic.parameters(), *actor.parameters()], strict=True):
                target.mul_(0.99).add_(0.01 * source)

    return update


def our_update(loss: DIPOLoss, batch: TensorDictBase, block: int) -> Callable[[], None]:
    """``block`` updates through the loss module; with 1, the calls that Algorithm 1 makes."""
    optimizers, target = make_optimizers(loss), SoftUpdate(loss, tau=0.01)
    many = torch.cat([batch] * block).reshape(block, -1)

    def one() -> None:
        data = batch.clone(False)
        step(loss.qvalue_loss(data)[0], optimizers[0])
        step(loss.actor_loss(data)[0], optimizers[1])
        target.step()

    def several() -> None:
        data = many.clone(False)
        for piece in loss.write_targets(data):
            step(loss.td_loss(piece)[0], optimizers[0])
        for piece in loss.write_refined(data):
            step(loss.diffusion_loss(piece)[0], optimizers[1])
        target.step()

    return one if block == 1 else several


def make_optimizers(loss: DIPOLoss) -> tuple[torch.optim.Optimizer, torch.optim.Optimizer]:
    """Adam for the critics with their encoder, and for the actor with its own."""
    groups: list[list[Tensor]] = [[], []]
    for name, parameter in loss.named_parameters():
        if not name.startswith("target_"):
            groups[name.startswith(("encoder_network", "actor_network"))].append(parameter)
    critic, actor = (torch.optim.Adam(group, 3e-4, fused=True) for group in groups)
    return critic, actor


def step(loss: Tensor, optimizer: torch.optim.Optimizer) -> None:
    """One clipped step of an optimiser."""
    optimizer.zero_grad()
    loss.backward()
    torch.nn.utils.clip_grad_norm_(optimizer.param_groups[0]["params"], 2.0)
    optimizer.step()


def sac_update(hidden: int, batch: TensorDictBase) -> Callable[[], None]:
    """TorchRL's SAC with a graph encoder in actor and critics and heads as wide as ours."""
    config = PolicyConfig(9, hidden=(hidden,) * 3)
    head = nn.Sequential(MLP(64, 4, num_cells=config.hidden, activation_class=nn.Mish), NormalParamExtractor())
    params = [("agents", "loc"), ("agents", "scale")]
    one = torch.ones(2)
    actor = ProbabilisticActor(
        TensorDictSequential(build_encoder(config), TensorDictModule(head, [EMBEDDING], params)),
        in_keys={"loc": params[0], "scale": params[1]},
        out_keys=[ACTION],
        distribution_class=TanhNormal,
        distribution_kwargs={"low": -one, "high": one},
        log_prob_key=("agents", "log_prob"),
    )
    critic = TensorDictModule(QNetwork(64, 2, config.hidden, True, "relu"), [EMBEDDING, ACTION], [VALUE])
    loss = SACLoss(actor, TensorDictSequential(build_encoder(config), critic), num_qvalue_nets=2, target_entropy=-2.0)
    keys = {"action": ACTION, "reward": REWARD, "state_action_value": VALUE, "log_prob": ("agents", "log_prob")}
    loss.set_keys(**keys, done=("agents", "done"), terminated=("agents", "terminated"), priority=("agents", "td_error"))
    loss.make_value_estimator(gamma=GAMMA)
    optimizer, target = torch.optim.Adam(loss.parameters(), 3e-4, fused=True), SoftUpdate(loss, tau=0.01)

    def update() -> None:
        losses = loss(batch.clone(False))
        step(losses["loss_actor"] + losses["loss_qvalue"] + losses["loss_alpha"], optimizer)
        target.step()

    return update


def where_time_goes(loss: DIPOLoss, batch: TensorDictBase, repeats: int) -> list[dict[str, Any]]:
    """The parts of one update, each timed by itself."""
    data = loss.write_refined(loss.write_targets(batch.clone()))
    following, keys = data["next"], loss.tensor_keys
    critic_optimizer, actor_optimizer = make_optimizers(loss)
    target = SoftUpdate(loss, tau=0.01)
    with torch.no_grad():
        actor_view = loss._embed(following, "encoder_network", target=True)
        critic_view = loss._critic_embedding(following, target=True)
    losses = {"critic": loss.td_loss(data)[0], "actor": loss.diffusion_loss(data)[0]}
    calls: dict[str, Callable[[], Any]] = {
        "target: encoders": lambda: (
            loss._embed(following, "encoder_network", target=True),
            loss._critic_embedding(following, target=True),
        ),
        "target: chain of the target policy": lambda: loss._sample_action(actor_view, loss.target_actor_network_params),
        "target: critics": lambda: loss._qvalues(critic_view, data[keys.action], loss.target_qvalue_network_params),
        "critic: forward": lambda: loss.td_loss(data),
        "critic: backward": lambda: losses["critic"].backward(retain_graph=True),
        "refinement": lambda: loss.write_refined(data),
        "actor: forward": lambda: loss.diffusion_loss(data),
        "actor: backward": lambda: losses["actor"].backward(retain_graph=True),
        "optimisers": lambda: (critic_optimizer.step(), actor_optimizer.step()),
        "target networks": target.step,
    }
    with torch.no_grad():
        times = alternate({name: no_grad_for(name, call) for name, call in calls.items()}, repeats, seconds=0.0)
    total = sum(timing.median for timing in times.values())
    return [
        {"part": name, "ms": 1e3 * timing.median, "share (%)": 100 * timing.median / total}
        for name, timing in times.items()
    ]


def no_grad_for(name: str, call: Callable[[], Any]) -> Callable[[], Any]:
    """Parts of the losses that are differentiated run with gradients, the others without."""
    return torch.enable_grad()(call) if name.startswith(("critic", "actor")) else call


if __name__ == "__main__":
    main(tyro.cli(Arguments))
