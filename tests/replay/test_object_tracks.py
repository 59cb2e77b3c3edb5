"""Another tracker's tracks: what they become, what is filled in, and that a predictor can work with them."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from pcgan.predictor import Predictor
from replay.object_tracks import ObjectTracksParams, TrackAssembler
from schemas import codec
from schemas.messages import ObjectTracks, TrackFrame, VehicleHistory
from tracking.geometry import transform_matrix
from tracking.tracker import LateScanError

START_NS = 1_700_000_000_000_000_000
MS = 1_000_000
IDENTITY = np.eye(4)
SOUND = np.diag([0.04, 0.05, 0.09, 0.1])


def objects(at_ms, people, frame_id="map"):
    """Objects of (id, x, y) or of dicts with id, x, y and, as wanted, v, cov, label, existence."""
    rows = [dict(zip(("id", "x", "y"), row, strict=True)) if isinstance(row, tuple) else row for row in people]
    A = len(rows)
    return ObjectTracks(
        START_NS + round(at_ms * MS),
        frame_id,
        tuple(row["id"] for row in rows),
        tuple(row.get("label", "pedestrian") for row in rows),
        np.array([(row["x"], row["y"], 0.9) for row in rows], float).reshape(A, 3),
        np.array([row.get("v", (np.nan,) * 3) for row in rows], float).reshape(A, 3),
        np.array([row.get("cov", np.full((4, 4), np.nan)) for row in rows], float).reshape(A, 4, 4),
        np.array([row.get("existence", 1.0) for row in rows], float),
    )


def assemble(assembler, message, map_from_frame=IDENTITY, **options):
    return assembler.step(message, map_from_frame, VehicleHistory.empty(), "odom", **options)


def yaw(angle_rad, x=0.0, y=0.0):
    return transform_matrix((x, y, 0.0), (0.0, 0.0, math.sin(angle_rad / 2), math.cos(angle_rad / 2)))


def ids(frame: TrackFrame) -> list[int]:
    return [track.id for track in frame.tracks]


def test_a_track_with_everything_comes_through_as_it_is():
    vehicle = VehicleHistory(np.array([START_NS]), np.array([[0.0, 0.0, 0.1, 2.0, 0.0]]))
    message = objects(0, [{"id": "a", "x": 3, "y": -1, "v": (1.2, 0.1, 0), "cov": SOUND, "existence": 0.75}])
    frame = TrackAssembler().step(message, IDENTITY, vehicle, "odom", pose_extrapolated=True, epoch=2, sequence=9)
    assert (frame.sequence, frame.stamp_ns, frame.frame_id) == (9, START_NS, "odom")
    assert (frame.pose_extrapolated, frame.epoch, frame.vehicle_history) == (True, 2, vehicle)
    (track,) = frame.tracks
    assert (track.id, track.existence, track.age_ns, track.coasting) == (1, 0.75, 0, False)
    np.testing.assert_array_equal(track.state, [3, -1, 1.2, 0.1])
    np.testing.assert_allclose(track.covariance, SOUND, rtol=1e-12)
    np.testing.assert_array_equal(track.history.stamps_ns, [START_NS])
    np.testing.assert_array_equal(track.history.states, [[3, -1, 1.2, 0.1]])


def test_nobody_is_a_frame_of_no_tracks():
    assembler = TrackAssembler()
    assert assemble(assembler, objects(0, [])).tracks == ()
    assert assemble(assembler, objects(100, [{"id": "a", "x": 1, "y": 1, "label": "car"}])).tracks == ()


def test_only_pedestrians_are_kept():
    labels = ["car", "pedestrian", "", "bicycle", "person"]
    message = objects(0, [{"id": label, "x": 5.0 * row, "y": 0, "label": label} for row, label in enumerate(labels)])
    assert [track.state[0] for track in assemble(TrackAssembler(), message).tracks] == [5, 10, 20]
    without = ObjectTracksParams(unlabelled_are_pedestrians=False)
    assert [track.state[0] for track in assemble(TrackAssembler(without, ("bicycle",)), message).tracks] == [15]


def test_ids_are_numbers_in_the_order_of_first_sight_whatever_the_order_of_messages():
    assembler = TrackAssembler()
    assert ids(assemble(assembler, objects(0, [("x", 0, 0), ("b", 5, 0)]))) == [1, 2]
    frame = assemble(assembler, objects(100, [("new", 10, 0), ("b", 5, 0), ("x", 0, 0)]))
    assert ids(frame) == [1, 2, 3]
    assert [track.state[0] for track in frame.tracks] == pytest.approx([0, 5, 10])
    assert [track.age_ns for track in frame.tracks] == [100 * MS, 100 * MS, 0]


def test_somebody_who_comes_back_soon_is_the_same_and_their_gap_stays():
    assembler = TrackAssembler()
    assemble(assembler, objects(0, [("a", 0, 0)]))
    assert ids(assemble(assembler, objects(500, [("b", 9, 0)]))) == [2]
    (track,) = assemble(assembler, objects(2000, [("a", 2, 0)])).tracks
    assert (track.id, track.age_ns) == (1, 2000 * MS)
    np.testing.assert_array_equal(track.history.stamps_ns, [START_NS, START_NS + 2000 * MS])


@pytest.mark.parametrize(("back_ms", "x"), [(3001, 0.0), (100, 3.0), (1000, 14.0)])
def test_an_id_that_comes_back_late_or_out_of_reach_is_somebody_new(back_ms, x):
    assembler = TrackAssembler()
    assemble(assembler, objects(0, [("a", 0, 0)]))
    (track,) = assemble(assembler, objects(back_ms, [("a", x, 0)])).tracks
    assert (track.id, track.age_ns, len(track.history.stamps_ns)) == (2, 0, 1)


def test_a_reset_clock_forgets_people_but_not_how_many_there_were():
    assembler = TrackAssembler()
    assemble(assembler, objects(5000, [("a", 0, 0), ("b", 1, 0)]))
    frame = assemble(assembler, objects(0, [("a", 0, 0)]), epoch=1)
    assert ids(frame) == [3]
    assert len(frame.tracks[0].history.stamps_ns) == 1


@pytest.mark.parametrize("at_ms", [100, 99, -5000])
def test_stamps_that_do_not_rise_are_refused_and_change_nothing(at_ms):
    assembler = TrackAssembler()
    assemble(assembler, objects(0, [("a", 0, 0)]))
    assemble(assembler, objects(100, [("a", 0, 0)]))
    with pytest.raises(LateScanError, match=f"tracks of {START_NS + at_ms * MS} ns come after those of"):
        assemble(assembler, objects(at_ms, [("a", 0.1, 0), ("b", 5, 0)]))
    frame = assemble(assembler, objects(200, [("a", 0, 0), ("c", 3, 0)]))
    assert ids(frame) == [1, 2]
    assert len(frame.tracks[0].history.stamps_ns) == 3


@pytest.mark.parametrize(
    ("people", "problem"),
    [
        ([("a", 0, 0), ("a", 5, 0)], "2 pedestrians have the id 'a'"),
        ([("a", np.nan, 0)], "track 'a' is not finite"),
        ([("a", 0, 1e10)], "track 'a' is not finite, or absurdly large"),
        ([{"id": "a", "x": 0, "y": 0, "existence": np.nan}], "existence of track 'a'"),
    ],
)
def test_what_makes_no_sense_is_refused_and_changes_nothing(people, problem):
    assembler = TrackAssembler()
    with pytest.raises(ValueError, match=problem):
        assemble(assembler, objects(0, people))
    assert ids(assemble(assembler, objects(0, [("b", 0, 0)]))) == [1]


def test_a_car_may_share_its_id_with_a_pedestrian():
    message = objects(0, [("7", 0, 0), {"id": "7", "x": 5, "y": 0, "label": "car"}])
    assert ids(assemble(TrackAssembler(), message)) == [1]


def test_history_is_as_long_as_the_settings_say():
    assembler = TrackAssembler(ObjectTracksParams(history_s=0.5))
    for k in range(20):
        frame = assemble(assembler, objects(100 * k, [("a", 0.1 * k, 0)]))
    (track,) = frame.tracks
    np.testing.assert_array_equal(track.history.stamps_ns, START_NS + np.arange(14, 20) * 100 * MS)
    np.testing.assert_array_equal(track.history.states[-1], track.state)
    assert track.age_ns == 1900 * MS


def test_existence_is_clipped_and_may_mark_coasting():
    assembler = TrackAssembler(ObjectTracksParams(coasting_below_existence=0.4))
    message = objects(
        0, [{"id": str(row), "x": 5 * row, "y": 0, "existence": p} for row, p in enumerate([-0.5, 0.3, 0.5, 1.5])]
    )
    tracks = assemble(assembler, message).tracks
    assert [track.existence for track in tracks] == [0, 0.3, 0.5, 1]
    assert [track.coasting for track in tracks] == [True, True, False, False]
    assert [track.history.coasting.tolist() for track in tracks] == [[True], [True], [False], [False]]


# --- covariances ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("given_covariance", "expected"),
    [
        (np.full((4, 4), np.nan), np.diag([0.01, 0.01, 0.09, 0.09])),
        (np.zeros((4, 4)), np.diag([0.01, 0.01, 0.09, 0.09])),  # as ROS says "unknown"
        (-SOUND, np.diag([0.01, 0.01, 0.09, 0.09])),
        (np.diag([0.04, 0.05, 0, 0]), np.diag([0.04, 0.05, 0.09, 0.09])),
        (np.diag([0.04, 0.05, np.nan, np.nan]), np.diag([0.04, 0.05, 0.09, 0.09])),
        (np.diag([0.04, 0.05, np.inf, 1e12]), np.diag([0.04, 0.05, 0.09, 0.09])),
        (SOUND, SOUND),
    ],
)
def test_a_covariance_that_says_nothing_is_replaced(given_covariance, expected):
    message = objects(0, [{"id": "a", "x": 1, "y": 2, "v": (1, 0, 0), "cov": given_covariance}])
    (track,) = assemble(TrackAssembler(), message, yaw(np.pi / 2) @ yaw(-np.pi / 2)).tracks
    np.testing.assert_allclose(track.covariance, expected, atol=1e-12)


ANY = st.floats() | st.sampled_from([0.0, 1.0, np.nan, np.inf, 1e308, 9.99e8, 9.99e7, 1e-7])


@given(
    hnp.arrays(float, (2, 4, 4), elements=ANY),
    hnp.arrays(float, (2, 3), elements=ANY),
    st.floats(-7, 7),
    st.integers(1, 4000),
)
def test_covariances_are_positive_definite_and_states_finite_whatever_comes(covariances, velocities, angle, later_ms):
    assembler = TrackAssembler()
    for at_ms, covariance, velocity in zip((0, later_ms), covariances, velocities, strict=True):
        message = objects(at_ms, [{"id": "a", "x": 1, "y": 2, "v": velocity, "cov": covariance}, ("b", 5, 5)])
        frame = assemble(assembler, message, yaw(angle, 3.0, 1.0))
        for track in frame.tracks:
            assert np.isfinite(track.state).all()
            np.testing.assert_array_equal(track.covariance, track.covariance.T)
            assert np.linalg.eigvalsh(track.covariance)[0] > 0
        codec.decode(TrackFrame, codec.encode(frame))


# --- frames --------------------------------------------------------------------------------------------------------


def test_a_moving_sensor_frame_is_taken_into_account():
    """A vehicle drives and turns past somebody who stands still: so they do in the odometry frame."""
    assembler = TrackAssembler()
    for k in range(10):
        map_from_frame = yaw(0.1 * k, 0.3 * k, 0.0)
        inverse = np.linalg.inv(map_from_frame)
        x, y, _, _ = inverse @ [4.0, 2.0, 0.0, 1.0]
        frame = assemble(assembler, objects(100 * k, [("a", x, y)], "base_link"), map_from_frame)
    np.testing.assert_allclose(frame.tracks[0].history.states, np.tile([4, 2, 0, 0], (10, 1)), atol=1e-12)


def test_velocity_in_a_tilted_frame_is_level_in_the_map():
    """A LiDAR 30 degrees nose down sees people climb who walk ahead; without that part their velocity is too short."""
    nose_down = transform_matrix((0, 0, 0), (0, math.sin(math.pi / 12), 0, math.cos(math.pi / 12)))
    velocity = np.linalg.inv(nose_down)[:3, :3] @ [1.0, 0.5, 0.0]
    message = objects(
        0,
        [
            {"id": "a", "x": 5, "y": 0, "v": velocity, "cov": SOUND},
            {"id": "b", "x": 5, "y": 2, "v": (1.0, 0.5, np.nan), "cov": SOUND},
        ],
    )
    first, second = assemble(TrackAssembler(), message, nose_down).tracks
    np.testing.assert_allclose(first.state[2:], [1.0, 0.5], atol=1e-12)
    np.testing.assert_allclose(second.state[2:], [math.cos(math.pi / 6), 0.5], atol=1e-12)


COORDINATE = st.floats(-20, 20)
SPEED = st.floats(-2, 2)


@st.composite
def walks(draw):
    """Three messages of up to four people, each with or without a velocity and a covariance."""
    count = draw(st.integers(0, 4))
    starts, steps = [
        draw(st.lists(st.tuples(unit, unit), min_size=count, max_size=count)) for unit in (COORDINATE, SPEED)
    ]
    roots = draw(hnp.arrays(float, (count, 4, 4), elements=st.floats(-1, 1)))
    messages = []
    for k in range(3):
        people = []
        for row in range(count):
            (x, y), (vx, vy) = starts[row], steps[row]
            person = {"id": str(row), "x": x + 0.5 * k * vx, "y": y + 0.5 * k * vy}
            if draw(st.booleans()):
                person["v"] = (vx, vy, 0.0)
            if draw(st.booleans()):
                person["cov"] = roots[row] @ roots[row].T + 0.01 * np.eye(4)
            people.append(person)
        messages.append(objects(500 * k, people))
    return messages


@given(walks(), st.floats(-7, 7), COORDINATE, COORDINATE, st.floats(-7, 7))
def test_turning_and_moving_the_scene_turns_and_moves_the_tracks(messages, angle, x, y, first_angle):
    before, after = TrackAssembler(), TrackAssembler()
    map_from_frame, moved = yaw(first_angle, 1.0, -2.0), yaw(angle, x, y)
    turn = np.kron(np.eye(2), moved[:2, :2])
    shift = np.array([x, y, 0.0, 0.0])
    for message in messages:
        one = assemble(before, message, map_from_frame)
        two = assemble(after, message, moved @ map_from_frame)
        assert ids(one) == ids(two)
        for track, other in zip(one.tracks, two.tracks, strict=True):
            np.testing.assert_allclose(other.state, turn @ track.state + shift, atol=1e-9)
            np.testing.assert_allclose(other.covariance, turn @ track.covariance @ turn.T, atol=1e-9)
            np.testing.assert_allclose(other.history.states, track.history.states @ turn.T + shift, atol=1e-9)


# --- velocities that are not given ---------------------------------------------------------------------------------


def test_a_velocity_is_what_the_positions_say():
    """Without accelerations the filter is a regression line with a prior for its slope: closed form."""
    sigma, first_speed = 0.2, 1.5
    params = ObjectTracksParams(
        position_sigma_m=sigma, first_speed_mps=first_speed, acceleration_mps2=1e-9, velocity_sigma_mps=9.0
    )
    assembler = TrackAssembler(params)
    at_ms = np.array([0, 100, 250, 300, 700])
    xs, ys = np.array([0.0, 0.2, 0.3, 0.5, 1.0]), np.array([3.0, 2.9, 2.95, 2.9, 2.8])
    for t, x, y in zip(at_ms, xs, ys, strict=True):
        frame = assemble(assembler, objects(t, [("a", x, y)]))
    design = np.column_stack([np.ones(5), (at_ms - at_ms[-1]) * 1e-3])  # position and velocity at the last stamp
    information = design.T @ design / sigma**2 + np.diag([0, 1 / first_speed**2])
    solved = np.linalg.solve(
        information, design.T @ np.column_stack([xs, ys]) / sigma**2
    )  # (position, velocity) x axis
    (track,) = frame.tracks
    np.testing.assert_allclose(track.state, solved.ravel(), rtol=1e-6)
    np.testing.assert_allclose(track.covariance, np.kron(np.linalg.inv(information), np.eye(2)), rtol=1e-6, atol=1e-12)


def test_a_steady_walker_gets_their_velocity():
    assembler = TrackAssembler()
    for k in range(31):
        frame = assemble(assembler, objects(100 * k, [("a", 0.13 * k, 5 - 0.05 * k)]))
    np.testing.assert_allclose(frame.tracks[0].state, [3.9, 3.5, 1.3, -0.5], atol=0.02)


def test_a_velocity_that_is_given_wins_and_the_filter_goes_on_from_it():
    assembler = TrackAssembler()
    assemble(assembler, objects(0, [("a", 0, 0)]))
    (given_one,) = assemble(assembler, objects(100, [{"id": "a", "x": 0.1, "y": 0, "v": (1, 0, 0)}])).tracks
    np.testing.assert_array_equal(given_one.state, [0.1, 0, 1, 0])
    (estimated,) = assemble(assembler, objects(200, [("a", 0.2, 0)])).tracks
    np.testing.assert_allclose(estimated.state, [0.2, 0, 1, 0], atol=1e-12)


# --- predictions ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("with_velocity", [False, True])
def test_the_predictor_answers_for_everybody_who_was_seen_twice(model, with_velocity):
    predictor, assembler = Predictor.from_checkpoint(model), TrackAssembler()
    fallbacks = []
    for k in range(36):
        walkers = [
            {"id": f"uuid-{row}", "x": 0.1 * k, "y": 2.0 * row, **({"v": (1, 0, 0)} if with_velocity else {})}
            for row in range(3)
        ]
        frame = assemble(assembler, objects(100 * k, walkers), sequence=k)
        answer = predictor.step(codec.decode(TrackFrame, codec.encode(frame)))
        assert [prediction.track_id for prediction in answer.predictions] == [1, 2, 3]
        fallbacks.append([prediction.fallback for prediction in answer.predictions])
    assert fallbacks[0] == [True] * 3
    assert fallbacks[-1] == [False] * 3


def test_tracks_marked_as_coasting_are_extrapolated(model):
    assembler = TrackAssembler(ObjectTracksParams(coasting_below_existence=0.5))
    for k in range(20):
        existence = 0.9 if k < 19 else 0.2
        message = objects(100 * k, [{"id": "a", "x": 0.1 * k, "y": 0, "existence": existence}])
        frame = assemble(assembler, message)
    (prediction,) = Predictor.from_checkpoint(model).step(frame).predictions
    assert prediction.fallback
