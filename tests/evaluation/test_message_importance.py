import pytest
import torch
from tensordict import TensorDict
from torchrl.envs.utils import ExplorationType, set_exploration_type

from redig.envs import corridor, formation_offsets
from redig.evaluation import message_importance
from redig.modules import DDPM, GraphEncoder
from redig.policy import ACTION, OBSERVATION, PolicyConfig, build_policy

CONFIG = PolicyConfig(observation_dim=9, embedding_dim=16, encoder_hidden=24, hidden=(32, 32), sampling_steps=4)
MAP = corridor()
GOAL = formation_offsets("wedge", 5).double() + torch.tensor([2.75, 0.0])


def observe(position):
    """The scenario's nine numbers: place, velocity, goal from there, distance and direction to the nearest wall."""
    distance, direction = MAP.nearest(position)
    velocity = torch.full_like(position, 0.3)
    return torch.cat([position, velocity, GOAL - position, distance.unsqueeze(-1), direction], -1)


def act_with(policy):
    def act(position):
        state = TensorDict({OBSERVATION: observe(position)}, position.shape[:-2])
        with set_exploration_type(ExplorationType.DETERMINISTIC):
            return policy(state)[ACTION]

    return act


def teams(seed=0, count=3):
    torch.manual_seed(seed)
    places = formation_offsets("wedge", 5, width=1.2).double() + torch.tensor([-1.7, 0.0])
    return places + 0.1 * torch.randn(count, 5, 2, dtype=torch.float64)


@pytest.mark.parametrize(("encoder", "seed"), [("edgeconv", 1), ("linear", 0)])  # weights whose actions are not clamped
def test_equals_finite_differences_through_encoder_and_chain(encoder, seed):
    torch.manual_seed(seed)
    activation = "relu" if encoder == "edgeconv" else None
    config = PolicyConfig(**{**vars(CONFIG), "encoder": encoder, "encoder_activation": activation})
    policy = build_policy(config).double()
    policy = type(policy)(policy[0], policy[1].with_sampler(DDPM(4)))
    act, position, step = act_with(policy), teams(), 1e-6
    expected = torch.zeros(3, 5, 5, dtype=torch.float64)
    with torch.no_grad():
        for j in range(5):
            for axis in range(2):
                moved = torch.zeros_like(position)
                moved[:, j, axis] = step
                slope = (act(position + moved) - act(position - moved)) / (2 * step)
                expected[:, :, j] += slope.square().sum(-1)
    found = message_importance(act, position)
    assert found.count_nonzero() > 30  # of 75; a message that is nowhere the largest counts for nothing
    torch.testing.assert_close(found, expected.sqrt(), rtol=1e-4, atol=1e-7)


def test_who_is_out_of_range_is_not_heard():
    position = teams(count=1)
    position[0, 4] += torch.tensor([-3.0, 0.0])
    encoder = GraphEncoder(9, 16, 24).double()
    found = message_importance(lambda p: encoder(observe(p)), position)[0]
    assert (found[:4, 4] == 0).all()
    assert (found[4, :4] == 0).all()
    assert (found[:4, :4] > 0).all()


def test_who_says_nothing_of_itself_is_not_heard_although_its_message_is_long():
    encoder = GraphEncoder(9, 16, 24).double()
    with torch.no_grad():
        encoder.message_mate.weight.zero_()  # nothing of the speaker's state
        encoder.message_edge.weight.zero_()  # nor of its place
    position = teams(count=2)
    found = message_importance(lambda p: encoder(observe(p)), position)
    apart = ~torch.eye(5, dtype=torch.bool)
    # z_j - z_i brings the robot's own state into its messages, but nobody else's
    assert (found[:, apart] == 0).all()
    assert (encoder.message_norms(observe(position))[:, apart] > 0.1).all()


def test_closed_form():
    gain = torch.randn(4, 4)
    found = message_importance(lambda p: gain @ p, torch.randn(2, 4, 2))
    torch.testing.assert_close(found, (2**0.5 * gain.abs()).expand(2, 4, 4))


def test_commands_that_depend_on_nothing():
    assert message_importance(torch.zeros_like, torch.zeros(3, 2)).eq(0).all()


def test_gradients_need_not_be_on():
    with torch.no_grad():
        found = message_importance(lambda p: 2 * p, torch.zeros(3, 2))
    torch.testing.assert_close(found, 2 * 2**0.5 * torch.eye(3))


def test_bad_shapes():
    with pytest.raises(ValueError, match=r"position: got shape \[5, 3\], expected \[\*B, n, 2\]"):
        message_importance(lambda p: p, torch.zeros(5, 3))
    with pytest.raises(ValueError, match=r"act: it returned shape \[2\], expected \[5, A\]"):
        message_importance(lambda p: p.sum(0), torch.zeros(5, 2))
