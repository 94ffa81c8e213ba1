import math
from dataclasses import replace

import pytest

from redig.deploy.messages import RobotState
from redig.deploy.transport import Faults, Radio, Sensed

STATE = RobotState("robot_0", 0.0, (0.0, 0.0), (0.0, 0.0), (5.0, 0.0), 1.0, (0.0, 1.0))


def heard(faults, messages=2000, seed=0, interval=0.1):
    """(time sent, time heard) of messages from one robot to another."""
    radio = Radio(faults, seed)
    sender, receiver = radio.join("robot_0"), radio.join("robot_1")
    log = []
    for step in range(messages + 50):
        radio.now = step * interval
        if step < messages:
            sender.send(Sensed(replace(STATE, stamp=radio.now), heading=0.0))
        log += [(state.stamp, radio.now) for state in receiver.receive()]
    assert sender.receive() == []  # nobody hears itself
    return log


def test_without_faults_everything_arrives_at_once_and_in_order():
    log = heard(Faults(), 100)
    assert [sent for sent, _ in log] == pytest.approx([0.1 * i for i in range(100)])
    assert all(sent == at for sent, at in log)


@pytest.mark.parametrize("loss", [0.1, 0.3, 0.5])
def test_loss_is_binomial(loss):
    count = len(heard(Faults(loss=loss)))
    assert abs(count - 2000 * (1 - loss)) < 5 * math.sqrt(2000 * loss * (1 - loss))


def test_delay():
    assert {round(at - sent, 6) for sent, at in heard(Faults(delay=0.2), 100)} == {0.2}


def test_jitter_reorders_and_is_bounded():
    log = heard(Faults(delay=0.1, jitter=0.5))
    stamps = [sent for sent, _ in log]
    assert stamps != sorted(stamps) and len(stamps) == 2000
    assert all(0.1 - 1e-6 <= at - sent <= 0.6 + 0.1 + 1e-6 for sent, at in log)  # looked for every 0.1 s


def test_duplicates_come_twice():
    stamps = [sent for sent, _ in heard(Faults(duplication=0.25))]
    assert len(set(stamps)) == 2000
    assert abs(len(stamps) - 2500) < 5 * math.sqrt(2000 * 0.25 * 0.75)


def test_equal_seeds_equal_faults():
    faults = Faults(loss=0.3, jitter=0.2, duplication=0.1)
    assert heard(faults, seed=1) == heard(faults, seed=1) != heard(faults, seed=2)


def test_receivers_lose_different_messages():
    radio = Radio(Faults(loss=0.5))
    sender, one, other = (radio.join(f"robot_{i}") for i in range(3))
    counts = []
    for _ in range(100):
        sender.send(Sensed(STATE, heading=0.0))
        counts.append((len(one.receive()), len(other.receive())))
    assert len(set(counts)) == 4


@pytest.mark.parametrize(
    ("fault", "value"),
    [("loss", 1.1), ("loss", math.nan), ("duplication", -0.1), ("delay", -1.0), ("jitter", math.inf)],
)
def test_bad_faults(fault, value):
    with pytest.raises(ValueError, match=f"^{fault}: got {value}"):
        Faults(**{fault: value})


def test_a_name_joins_once():
    radio = Radio()
    radio.join("robot_0")
    with pytest.raises(ValueError, match="robot: got 'robot_0'"):
        radio.join("robot_0")
