"""A plan that has gone into a bad local minimum is left again: laps stay on the track."""

from pathlib import Path

import pytest

from tests.programs import Race


@pytest.mark.check
@pytest.mark.unmeasured
def test_with_a_model_that_is_right_the_laps_stay_on_the_track(tmp_path: Path) -> None:
    """Before there were second starts, the updated laps left this track, 5 % slower."""
    pair = ("--track", "random:11", "--train-track", "random:3")
    race = Race.running(tmp_path / "race", *pair)()
    updated, perfect = race.lap("bayesrace-updated"), race.lap("bestcase")
    assert updated["off_track_samples"] == perfect["off_track_samples"] == 0
    assert updated["lap_time_s"] <= perfect["lap_time_s"] + 0.02
    assert updated["flying_lap_time_s"] <= perfect["flying_lap_time_s"] + 0.02
