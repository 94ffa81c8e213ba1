import logging

import pytest

from redig.deploy.events import Events


@pytest.fixture
def told(caplog):
    """Events of a clock in ``told.now``, and what has been logged."""
    caplog.set_level(logging.INFO)

    class Told:
        now = 0.0

        def __init__(self):
            self.events = Events(logging.getLogger("test"), quiet=10.0, clock=lambda: self.now)

        @property
        def lines(self):
            return [record.message for record in caplog.records]

    return Told()


def test_what_goes_on_is_told_once(told):
    for step in range(1000):
        told.now = 0.1 * step
        told.events.begin("x", "begins")
    told.events.end("x", "ends")
    told.events.end("x", "ends")
    assert told.lines == ["begins", "ends"]


def test_what_was_quiet_for_long_is_told_again(told):
    for told.now in (0.0, 9.0, 18.0, 28.1, 30.0):
        told.events.begin("x", "begins")
    assert told.lines == ["begins", "begins"]


def test_what_comes_and_goes_is_told_now_and_then(told):
    for step in range(300):
        told.now = 0.1 * step
        told.events.begin("x", "begins")
        told.events.end("x", "ends")
    assert told.lines == ["begins", "ends"] * 3


def test_events_do_not_hide_each_other(told):
    told.events.begin("x", "x")
    told.events.begin("y", "y")
    told.events.end("z", "z")
    assert told.lines == ["x", "y"]
