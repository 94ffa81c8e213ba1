"""Losses around small networks, some of them known in closed form, and batches for them."""

import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.data import Bounded

from redig.modules import DDPM, DenoisingMLP, DiffusionActor, GraphEncoder, NoiseSchedule, QNetwork
from redig.objectives import DIPOLoss

NETWORKS = ("encoder", "critic_encoder", "actor", "qvalue")


class ConstantActor(nn.Module):
    """Does the same everywhere; its diffusion loss is the plain squared error."""

    def __init__(self, action):
        super().__init__()
        self.action = nn.Parameter(torch.tensor(action))
        self.register_buffer("low", torch.full((len(action),), -1.0))
        self.register_buffer("high", torch.full((len(action),), 1.0))

    def forward(self, embedding):
        return self.action.expand(*embedding.shape[:-1], -1)

    def action_loss(self, action, embedding):
        return (action - self.action).square().mean(-1)


class LinearQ(nn.Module):
    """Q = w . [h, a]."""

    def __init__(self, width):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(width))

    def forward(self, embedding, action):
        return (torch.cat([embedding, action], -1) * self.weight).sum(-1, keepdim=True)


class QuadraticQ(nn.Module):
    """Q = -|a - best|^2."""

    def __init__(self, best):
        super().__init__()
        self.best = nn.Parameter(torch.tensor(best))

    def forward(self, embedding, action):
        return -(action - self.best).square().sum(-1, keepdim=True)


def make(cls=DIPOLoss, seed=0, actor_seed=None, key=lambda name: name, separate=False, **options):
    """A loss around small networks; ``actor_seed`` gives the actor a generator of its own."""
    torch.manual_seed(seed)
    in_keys, out_keys = [key("observation")], [key("embedding")]
    encoder, own = (TensorDictModule(GraphEncoder(4, 8, 8), in_keys=in_keys, out_keys=out_keys) for _ in range(2))
    actor = DiffusionActor(
        DenoisingMLP(2, 8, (16,)),
        Bounded(-1, 1, (3, 2)),
        in_keys=out_keys,
        out_keys=[key("action")],
        schedule=NoiseSchedule(5),
        generator=None if actor_seed is None else torch.Generator().manual_seed(actor_seed),
    )
    value = TensorDictModule(
        QNetwork(8, 2, (16,)), in_keys=[*out_keys, key("action")], out_keys=[key("state_action_value")]
    )
    return cls(encoder, actor, value, critic_encoder=own if separate else None, **options)


def single(cls=DIPOLoss, **options):
    """One robot without an encoder: observation ``[B, 1]``, action ``[B, 1]``."""
    torch.manual_seed(0)
    actor = DiffusionActor(
        DenoisingMLP(1, 1, (32, 32)),
        Bounded(-1.0, 1.0, (1,)),
        in_keys=["observation"],
        out_keys=["action"],
        schedule=NoiseSchedule(10),
        sampler=DDPM(num_steps=5),
    )
    value = TensorDictModule(QNetwork(1, 1, (32, 32)), ["observation", "action"], ["state_action_value"])
    return cls(None, actor, value, **options).make_value_estimator(gamma=0.9)


def constant(cls=DIPOLoss, action=(0.3, -0.2), **options):
    """A loss around networks that are known in closed form: linear encoder, constant actor, linear critics."""
    if cls is DIPOLoss:
        options = {"refine_steps": 0, **options}
    torch.manual_seed(0)
    encoder = TensorDictModule(nn.Linear(4, 3, bias=False), in_keys=["observation"], out_keys=["embedding"])
    actor = TensorDictModule(ConstantActor(action), in_keys=["embedding"], out_keys=["action"])
    value = TensorDictModule(LinearQ(5), in_keys=["embedding", "action"], out_keys=["state_action_value"])
    loss = cls(encoder, actor, value, **options)
    for name in ("encoder", "actor", "qvalue"):  # all different from their targets
        for which in ("", "target_"):
            for key, leaf in getattr(loss, f"{which}{name}_network_params").items(True, True):
                if key[-1] not in ("low", "high"):
                    leaf.data.copy_(torch.randn(leaf.shape))
    return loss.make_value_estimator(gamma=0.9)


def known(loss, which=""):
    """Weights of :func:`constant`: encoder ``[3, 4]``, action ``[2]``, critics ``[2, 5]``."""
    names = (("encoder", "weight"), ("actor", "action"), ("qvalue", "weight"))
    return [getattr(loss, f"{which}{network}_network_params")["module", leaf].detach() for network, leaf in names]


def valued_by(critic, cls=DIPOLoss, actor=None, **options):
    """A loss without encoder around one critic that is given, and an actor that does nothing unless given."""
    if actor is None:
        actor = TensorDictModule(ConstantActor([0.0, 0.0]), in_keys=["observation"], out_keys=["action"])
    value = TensorDictModule(critic, in_keys=["observation", "action"], out_keys=["state_action_value"])
    loss = cls(None, actor, value, **options)
    for params in (loss.qvalue_network_params, loss.target_qvalue_network_params):  # copies of a critic start apart
        for key, leaf in params.items(True, True):
            leaf.data.copy_(dict(critic.named_parameters())[key[-1]])
    return loss


def transitions(*batch, n=3, seed=0):
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape):
        return torch.randn(*batch, *shape, generator=generator)

    terminated = torch.rand(*batch, n, 1, generator=generator) < 0.3
    following = {"observation": normal(n, 4), "reward": normal(n, 1), "done": terminated, "terminated": terminated}
    return TensorDict({"observation": normal(n, 4), "action": normal(n, 2).clamp(-1, 1), "next": following}, batch)


def bandit(action):
    """Transitions of one robot in one state, one step an episode, reward ``-(a - 0.6)^2``."""
    count = len(action)
    flag, observation = torch.ones(count, 1, dtype=torch.bool), torch.zeros(count, 1)
    following = {"observation": observation, "reward": -((action - 0.6) ** 2), "done": flag, "terminated": flag}
    return TensorDict({"observation": observation, "action": action, "next": following}, [count])


def act(loss, count=256):
    """Actions of the loss's actor in the state of :func:`bandit`."""
    with torch.no_grad(), loss.actor_network_params.to_module(loss.actor_network):
        return loss.actor_network(observation=torch.zeros(count, 1))


def gradient(loss, name):
    """Largest gradient of a network's parameters, or ``None`` where none arrived."""
    grads = [p.grad for p in getattr(loss, f"{name}_network_params").parameters() if p.grad is not None]
    return max(g.abs().max().item() for g in grads) if grads else None


def nested(name):
    return ("team", "deep", name)
