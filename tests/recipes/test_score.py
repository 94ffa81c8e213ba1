"""Which policy of a run is kept: by success first, whatever its jerk."""

from finish import score
from hypothesis import given
from hypothesis import strategies as st

SHARE = st.floats(0, 1)
NAN = float("nan")


def metrics(success, team, time, cfi, jerk):
    return {
        "success_rate": success,
        "team_success_rate": team,
        "travel_time": time,
        "travel_time_teams": float(team > 0),
        "cfi_0.5": cfi,
        "jerk_mean": jerk,
    }


@given(success=st.floats(0.01, 1), cfi=SHARE, jerk=st.floats(0, 40))
def test_a_robot_that_arrives_is_worth_more_than_a_team_that_stands(success, cfi, jerk):
    assert score(metrics(success, 0.0, NAN, cfi, jerk)) > score(metrics(0.0, 0.0, NAN, 1.0, 0.0))


@given(cfi=SHARE, jerk=st.floats(0, 40), time=st.floats(5, 20))
def test_a_whole_team_is_worth_more_than_one_that_loses_half_its_robots(cfi, jerk, time):
    assert score(metrics(1.0, 1.0, time, cfi, jerk)) > score(metrics(0.5, 0.0, NAN, 1.0, 0.0))


def test_among_equals_the_whole_the_fast_and_the_smooth_one_is_better():
    best = score(metrics(1.0, 1.0, 6.5, 0.95, 1.5))
    assert best > score(metrics(1.0, 1.0, 6.5, 0.90, 1.5))
    assert best > score(metrics(1.0, 1.0, 7.0, 0.95, 1.5))
    assert best > score(metrics(1.0, 1.0, 6.5, 0.95, 3.0))
    assert best == score(metrics(1.0, 1.0, 6.5, 0.95, 2.0))  # below 2 m/s³ jerk does not count
