import pytest
import torch
from torchrl.envs import VmasEnv
from vmas.simulator.environment.environment import Environment

from redig.envs import FormationNavigation
from redig.envs.seeding import preserve_rng_state


@pytest.mark.parametrize("fails", [False, True])
def test_torch_and_vmas_draw_the_same_as_without_the_block(fails):
    env = VmasEnv(FormationNavigation(), num_envs=2)

    def draw(disturb: bool):
        torch.manual_seed(0)
        env.set_seed(0)
        state = Environment.vmas_random_state
        if disturb:
            try:
                with preserve_rng_state():
                    env.set_seed(5)
                    torch.manual_seed(5)
                    env.rollout(2)
                    if fails:
                        raise KeyError
            except KeyError:
                pass
        assert Environment.vmas_random_state is state
        return torch.rand(4), env.reset()["agents", "observation"]

    for expected, found in zip(draw(False), draw(True), strict=True):
        assert torch.equal(expected, found)
