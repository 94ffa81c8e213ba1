from config import Config

from redig.envs import ActionDelay, ObservationNoise, make_env


def kinds(env):
    return {type(transform) for transform in env.transform}


def test_randomisation_is_off_by_default():
    env = make_env(1, **Config().randomisation())
    assert not kinds(env) & {ActionDelay, ObservationNoise}
    assert env.scenario.acceleration_range is None
    assert env.scenario.turn_gain is None


def test_options_reach_the_environment_also_from_a_saved_configuration():
    saved = {"action_delay": [0, 2], "observation_noise": 0.05, "acceleration_range": [0.5, 1.0], "turn_gain": [2, 8]}
    # lists, as JSON has it
    env = make_env(1, **Config(**saved).randomisation())
    assert kinds(env) >= {ActionDelay, ObservationNoise}
    assert tuple(env.scenario.acceleration_range) == (0.5, 1.0)
    assert tuple(env.scenario.turn_gain) == (2, 8)


def test_the_task_of_the_final_evaluation_is_without():
    config = Config(action_delay=(0, 2), observation_noise=0.05, acceleration_range=(0.5, 1.0), turn_gain=(2, 8))
    assert not config.scenario().keys() & config.randomisation().keys()
