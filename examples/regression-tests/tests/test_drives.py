"""Every recorded drive, replayed once per run: what must hold for all of them, and what for one."""

import pytest

every_drive = pytest.mark.pcgan_log("drives/*.mcap")


@every_drive
def test_the_recording_is_read_whole(replayed):
    assert replayed.refused == 0, replayed.summary["refusals"]


@every_drive
def test_tracks_and_predictions_are_good_enough(replayed):
    assert replayed.scores.hota >= 0.9
    assert replayed.scores.id_switches <= 1
    assert replayed.scores.ade_m <= 1.0


@every_drive
def test_nobody_near_the_vehicle_is_lost_for_half_a_second(replayed):
    assert [gap for gap in replayed.untracked(within_m=5) if gap.duration_s > 0.5] == []


@every_drive
def test_the_output_is_as_it_was(replayed):
    replayed.assert_matches_reference(atol=0.01)


def test_who_walks_across_is_foreseen_until_the_road_is_clear(replay_log):
    """Ids change with settings, places do not: this is whoever was there, in the odometry frame, after 1.9 s."""
    person = replay_log("drives/crossing.mcap").track_near(x_m=24.3, y_m=-0.5, at_s=1.9)
    assert person.corridor_probability[person.at_s < 4].min() > 0.8
    assert person.corridor_probability[person.at_s > 7].max() < 0.2


def test_a_shorter_horizon_errs_less(replay_log):
    usual = replay_log("drives/crowd.mcap")
    short = replay_log("drives/crowd.mcap", model="vehicle_10hz", name="10hz")
    assert short.scores.ade_m < usual.scores.ade_m
