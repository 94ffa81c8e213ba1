"""DIPOLoss on environments that know nothing of formations: Gymnasium, VMAS, PettingZoo, and teams of several kinds."""

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv
from tensordict.nn import TensorDictModule, TensorDictSequential
from torch import nn
from torch.optim import Adam
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.envs import GymEnv, PettingZooWrapper, StepCounter, TransformedEnv, VmasEnv
from torchrl.envs.utils import ExplorationType, set_exploration_type
from torchrl.objectives import SoftUpdate

from redig.modules import DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, NoiseSchedule, QNetwork
from redig.objectives import DIPOLoss

HIDDEN = (32, 32)
pytestmark = pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested")


class Targets(ParallelEnv):
    """Robots that each see a target and are paid for naming it; their kinds see it at different places.

    ``widths`` is the observation width of each kind of robot: the target comes last, behind zeros.
    """

    metadata = {"name": "targets_v0"}  # noqa: RUF012
    render_mode = None

    def __init__(self, widths, steps=4):
        self.widths = {f"{kind}_{i}": width for kind, width in widths.items() for i in range(2)}
        self.possible_agents = list(self.widths)
        self.agents, self.steps = [], steps
        self.spaces = {agent: Box(-1, 1, (width,), np.float32) for agent, width in self.widths.items()}
        self.actions = {agent: Box(-1, 1, (2,), np.float32) for agent in self.possible_agents}
        self.random = np.random.default_rng(0)

    def observation_space(self, agent):
        return self.spaces[agent]

    def action_space(self, agent):
        return self.actions[agent]

    def reset(self, seed=None, options=None):
        if seed is not None:
            self.random = np.random.default_rng(seed)
        self.agents, self.count = self.possible_agents.copy(), 0
        return self.observe(), {agent: {} for agent in self.agents}

    def observe(self):
        self.target = {agent: self.random.uniform(-0.9, 0.9, 2).astype(np.float32) for agent in self.possible_agents}
        return {a: np.concatenate([np.zeros(self.widths[a] - 2, np.float32), self.target[a]]) for a in self.target}

    def step(self, actions):
        rewards = {agent: -float(np.square(action - self.target[agent]).sum()) for agent, action in actions.items()}
        self.count += 1
        names, over = self.possible_agents, self.count == self.steps
        if over:
            self.agents = []
        truncated, infos = dict.fromkeys(names, over), {agent: {} for agent in names}
        return self.observe(), rewards, dict.fromkeys(names, False), truncated, infos


class Lift(nn.Module):
    """An encoder for a team of several kinds: each kind's own layer lifts it to one width, then all hear each other."""

    def __init__(self, widths, embedding_dim):
        super().__init__()
        self.lift = nn.ModuleList(nn.Linear(width, embedding_dim) for width in widths)
        self.graph = GraphEncoder(embedding_dim, embedding_dim, 16)

    def forward(self, *observations):
        """Observations ``[*B, n_k, F_k]`` of each kind to embeddings ``[*B, n_k, H]``."""
        lifted = [lift(observation) for lift, observation in zip(self.lift, observations, strict=True)]
        return self.graph(torch.cat(lifted, -2)).split([part.shape[-2] for part in lifted], -2)


def make_actor(env, embedding, width, action):
    spec = env.full_action_spec[action]
    return DiffusionActor(
        DenoisingMLP(spec.shape[-1], width, HIDDEN),
        env.full_action_spec,
        in_keys=[embedding],
        out_keys=[action],
        schedule=NoiseSchedule(20),
        sampler=DDPM(num_steps=5),
    )


def make_loss(encoder, actor, env, width, group=None, **kwargs):
    """The loss of one group of robots, or of a single agent (``group=None``), with the critics that it needs."""

    def key(name):
        return name if group is None else (group, name)

    state, action = actor.in_keys[0], actor.out_keys[0]
    critic = TensorDictModule(
        QNetwork(width, env.full_action_spec[action].shape[-1], HIDDEN),
        in_keys=[state, action],
        out_keys=[key("state_action_value")],
    )
    loss = DIPOLoss(encoder, actor, critic, **kwargs)
    names = ("action", "reward", "state_action_value", "refined_action")
    loss.set_keys(priority=key("td_error"), **{name: key(name) for name in names})
    return loss.make_value_estimator(gamma=0.9)


def make_team(env, group, **kwargs):
    """Policy and loss of a team with one graph encoder."""
    observation, embedding, action = (group, "observation"), (group, "embedding"), (group, "action")
    width = env.observation_spec[observation].shape[-1]
    encoder = TensorDictModule(GraphEncoder(width, 16, 16), in_keys=[observation], out_keys=[embedding])
    actor = make_actor(env, embedding, 16, action)
    return TensorDictSequential(encoder, actor), make_loss(encoder, actor, env, 16, group, **kwargs)


def train(env, policy, losses, frames=320, updates=2, lr=1e-2):
    """Train with TorchRL's own collector and buffer, and check what the losses give; the last batch."""
    parameters = {id(p): p for loss in losses for p in loss.parameters()}  # an encoder may be shared
    optimizer, targets = Adam(parameters.values(), lr), [SoftUpdate(loss, tau=0.05) for loss in losses]
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(10_000), batch_size=32)
    for data in Collector(env, policy, frames_per_batch=frames // 4, total_frames=frames):
        buffer.extend(data.reshape(-1))
        for _ in range(updates):
            batch = buffer.sample()
            for loss in losses:
                out = loss(batch)
                assert set(out.keys()) == set(loss.out_keys) > {"loss_qvalue", "loss_actor"}
                assert all(value.shape == () and torch.isfinite(value) for value in out.values())
                (out["loss_qvalue"] + out["loss_actor"]).backward()
            optimizer.step()
            optimizer.zero_grad()
            for target in targets:
                target.step()
    return batch


def check_loss(loss, batch, low, high):
    """What the loss writes into its batch, and that each of the two losses teaches the networks that it should."""
    keys, action = loss.tensor_keys, batch[loss.tensor_keys.action]
    assert batch[keys.priority].shape == batch["next", keys.reward].shape == (*action.shape[:-1], 1)
    assert (batch[keys.priority] >= 0).all()
    refined = batch[keys.refined_action]
    assert refined.shape == action.shape and not torch.equal(refined, action)
    assert (refined >= low).all() and (refined <= high).all()
    taught = {"loss_qvalue": {"encoder_network", "qvalue_network"}, "loss_actor": {"encoder_network", "actor_network"}}
    for name, networks in taught.items():
        loss.zero_grad()
        loss(batch)[name].backward()
        reached = {
            parameter.split("_params")[0]
            for parameter, value in loss.named_parameters()
            if value.grad is not None and value.grad.any()
        }
        assert reached == (networks if loss.has_encoder else networks - {"encoder_network"})


def mean_reward(env, policy, groups):
    with torch.no_grad(), set_exploration_type(ExplorationType.DETERMINISTIC):
        rollouts = torch.stack([env.rollout(4, policy) for _ in range(16)])
    return [rollouts["next", group, "reward"].mean().item() for group in groups]


def test_a_single_agent_of_gymnasium():
    torch.manual_seed(0)
    env = TransformedEnv(GymEnv("Pendulum-v1"), StepCounter(50))
    actor = make_actor(env, "observation", 3, "action")
    loss = make_loss(None, actor, env, 3)
    batch = train(env, actor, [loss])
    assert batch["next", "reward"].shape == (32, 1)
    check_loss(loss, batch, -2, 2)


@pytest.mark.parametrize("scenario", ["navigation", "balance"])
def test_scenarios_of_vmas(scenario):
    torch.manual_seed(0)
    env = TransformedEnv(VmasEnv(scenario, num_envs=8, n_agents=3), StepCounter(20))
    policy, loss = make_team(env, "agents")
    batch = train(env, policy, [loss])
    assert batch["next", "done"].shape == (32, 1)  # the team's, for rewards [32, 3, 1]
    check_loss(loss, batch, -1, 1)


def test_a_parallel_environment_of_pettingzoo():
    torch.manual_seed(0)
    env = PettingZooWrapper(Targets({"robot": 4}), seed=0)
    policy, loss = make_team(env, "robot")
    batch = train(env, policy, [loss])
    check_loss(loss, batch, -1, 1)
    loss.set_keys(done=("robot", "done"), terminated=("robot", "terminated"))  # PettingZoo has them for each robot too
    check_loss(loss, batch, -1, 1)


def test_groups_of_vmas_with_a_loss_each():
    torch.manual_seed(0)
    env = TransformedEnv(VmasEnv("simple_tag", num_envs=8), StepCounter(20))
    groups = list(env.group_map)
    policies, losses = zip(*(make_team(env, group) for group in groups), strict=True)
    batch = train(env, TensorDictSequential(*policies), losses)
    for group, loss in zip(groups, losses, strict=True):
        check_loss(loss, batch, -1, 1)
        assert batch[group, "td_error"].shape == (32, len(env.group_map[group]), 1)
    widths = {env.observation_spec[group, "observation"].shape[-1] for group in groups}
    assert len(widths) == 2


def test_one_encoder_for_a_team_of_two_kinds_which_learns():
    torch.manual_seed(0)
    widths = {"scout": 2, "carrier": 5}
    env = PettingZooWrapper(Targets(widths), seed=0)
    encoder = TensorDictModule(
        Lift(widths.values(), 16), [(kind, "observation") for kind in widths], [(kind, "embedding") for kind in widths]
    )
    actors = [make_actor(env, (kind, "embedding"), 16, (kind, "action")) for kind in widths]
    losses = [make_loss(encoder, a, env, 16, kind, refine_steps=5) for a, kind in zip(actors, widths, strict=True)]
    policy = TensorDictSequential(encoder, *actors)
    before = mean_reward(env, policy, widths)
    batch = train(env, policy, losses, frames=480, updates=40)
    for loss in losses:
        check_loss(loss, batch, -1, 1)
    # the best that does not look at its observation stands still, for a mean of 2 * -0.9**2 / 3 = -0.54
    assert all(reward < -0.54 for reward in before)
    assert all(reward > -0.27 for reward in mean_reward(env, policy, widths))
