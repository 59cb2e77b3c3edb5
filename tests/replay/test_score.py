"""The score in closed form: perfect, a metre off, coasting, lost ids, and the ground truth's people."""

import json
from dataclasses import replace

import numpy as np
import pytest

from replay.score import MATCH_M, MAX_GAP_NS, Errors, Positions, ReplayScore, lookup
from schemas.messages import ModalPath

P = 3  # predicted steps, 0.1 s each, as far apart as the frames


def walk(at_s, start=(5.0, 2.0), velocity=(1.2, -0.5)):
    return np.array(start) + at_s * np.array(velocity)


@pytest.fixture
def drive(make):
    """Makes frame results of one walker with a prediction each; `off` shifts the predicted paths."""

    def made(count=20, *, off=(0.0, 0.0), coasting=(), velocity=(1.2, -0.5), id_of=lambda _: 1, **changes):
        for i in range(count):
            state = (*walk(0.1 * i, velocity=velocity), *velocity)
            track = make.track(100 * i, id_of(i), state, coasting=i in coasting)
            path = [walk(0.1 * (i + k), velocity=velocity) + off for k in range(1, P + 1)]
            prediction = make.prediction(id_of(i), path, sigma=0.5, fallback=changes.get("fallback", False))
            truth = changes["truth"](i) if "truth" in changes else None
            yield make.result(100 * i, [track], [prediction], truth, epoch=changes.get("epoch", 0), sequence=i)

    return made


def scored(frames):
    score = ReplayScore()
    for frame in frames:
        score.add(frame)
    figures = score.as_json()
    json.dumps(figures)
    return figures


def test_a_perfect_prediction_has_no_error(drive):
    figures = scored(drive())
    assert figures["scored"] == 20 - P  # the last ones reach past the end
    assert figures["scored_share"] == pytest.approx((20 - P) / 20)
    assert figures["ade_m"] == pytest.approx(0, abs=1e-9)
    assert figures["fde_m"] == pytest.approx(0, abs=1e-9)
    assert figures["mhd_m"] == pytest.approx(0, abs=1e-9)


def test_walking_straight_the_extrapolated_track_is_perfect_too(drive):
    tracker = scored(drive(off=(9, 9)))["tracker"]
    assert tracker["ade_m"] == pytest.approx(0, abs=1e-9)
    assert tracker["fde_m"] == pytest.approx(0, abs=1e-9)


def test_a_path_one_metre_off_everywhere_errs_by_one_metre(drive):
    """Sideways of a straight walk, the modified Hausdorff distance is a metre, too."""
    across = np.array([0.5, 1.2]) / 1.3
    figures = scored(drive(off=across))
    assert figures["ade_m"] == pytest.approx(1, abs=1e-6)
    assert figures["fde_m"] == pytest.approx(1, abs=1e-6)
    assert figures["mhd_m"] == pytest.approx(1, abs=1e-6)


def test_the_likelihood_of_the_mean_of_one_gaussian(drive):
    """-log N(mean; sigma = 0.5 m) = log(2 pi 0.25); a metre off adds 1 / (2 0.25)."""
    at_mean = np.log(2 * np.pi * 0.25)
    assert scored(drive())["nll"] == pytest.approx(at_mean, abs=1e-5)
    assert scored(drive(off=(1.0, 0.0)))["nll"] == pytest.approx(at_mean + 2, abs=1e-5)


def test_fde_is_the_last_step_alone(make):
    """Predicted standing, walked at 1 m/s along x: 0.1, 0.2, 0.3 m off."""
    frames = []
    for i in range(10):
        track = make.track(100 * i, 1, (0.1 * i, 0, 1, 0))
        frames.append(make.result(100 * i, [track], [make.prediction(1, [[0.1 * i, 0]] * P)], sequence=i))
    figures = scored(frames)
    assert figures["ade_m"] == pytest.approx(0.2)
    assert figures["fde_m"] == pytest.approx(0.3)


def test_the_most_probable_path_is_scored(drive):
    def swapped(frame):
        (prediction,) = frame.predictions.predictions
        (right,) = prediction.paths
        paths = (ModalPath(0.6, right.points_m), ModalPath(0.4, right.points_m + 5))
        answered = replace(frame.predictions, predictions=(replace(prediction, paths=paths),))
        return replace(frame, predictions=answered)

    assert scored(map(swapped, drive()))["ade_m"] == pytest.approx(0, abs=1e-9)


@pytest.mark.parametrize(("coasting", "unscored"), [
    ((), 0),
    ((10,), 0),  # measured 0.2 s apart: interpolated
    ((10, 11), 0),  # 0.3 s apart
    ((10, 11, 12), 3 + P - 1),  # 0.4 s: who has a step at 10, 11 or 12
    ((10, 11, 12, 13, 14), 5 + P - 1),
], ids=str)  # fmt: skip
def test_steps_at_which_the_track_coasted_are_not_counted(drive, coasting, unscored):
    """A coasting track is where the tracker guesses: no truth to compare with."""
    assert scored(drive(coasting=coasting))["scored"] == 20 - P - unscored


def test_positions_between_frames_are_interpolated(make):
    """Steps of 0.05 s, frames every 0.1 s."""
    frames = []
    for i in range(10):
        track = make.track(100 * i, 1, (0.1 * i, 0, 1, 0))
        path = [[0.1 * i + 0.05 * k, 0] for k in range(1, P + 1)]
        frames.append(make.result(100 * i, [track], [make.prediction(1, path)], dt_s=0.05, sequence=i))
    figures = scored(frames)
    assert figures["scored"] == 8  # 0.15 s ahead
    assert figures["ade_m"] == pytest.approx(0, abs=1e-9)


def test_a_track_that_changes_its_id_is_somebody_else(drive):
    """Predictions that reach over the change cannot be scored."""
    assert scored(drive(id_of=lambda i: 1 if i < 10 else 2))["scored"] == (10 - P) + (10 - P)


def test_another_tracks_positions_are_never_used(make):
    """Two walkers far apart, predicted perfectly; rows in falling order of id."""
    frames = []
    for i in range(12):
        tracks = [make.track(100 * i, id, (10 * id + 0.1 * i, 0, 1, 0)) for id in (7, 3)]
        paths = [make.prediction(id, [[10 * id + 0.1 * (i + k), 0] for k in range(1, P + 1)]) for id in (7, 3)]
        frames.append(make.result(100 * i, tracks, paths, sequence=i))
    figures = scored(frames)
    assert figures["scored"] == 2 * (12 - P)
    assert figures["ade_m"] == pytest.approx(0, abs=1e-9)


def test_fallbacks_are_counted_and_left_out(drive):
    figures = scored(drive(fallback=True))
    assert (figures["fallbacks"], figures["scored"], figures["scored_share"]) == (20, 0, 0)
    assert figures["ade_m"] is None


def test_an_epoch_ends_what_was_predicted_before(drive):
    """Ids and stamps begin anew: predictions of the old epoch are not compared with tracks of the new one."""
    frames = [*drive(10), *drive(10, epoch=1, off=(0, 0))]
    assert scored(frames)["scored"] == 2 * (10 - P)


def test_nothing_gives_nothing():
    figures = scored([])
    assert (figures["scored"], figures["scored_share"], figures["ade_m"], figures["fallbacks"]) == (0, None, None, 0)
    assert "ground_truth" not in figures


def test_frames_without_people_are_fine(make):
    assert scored(make.result(100 * i) for i in range(10))["scored"] == 0


# --- against the ground truth ----------------------------------------------------------------------------------------


def test_predictions_are_compared_with_the_person_a_track_stands_for(drive, make):
    """The tracks are 0.3 m beside the person; a perfect path of the track is 0.3 m off the person's."""
    figures = scored(drive(truth=lambda i: make.truth(100 * i, [(42, *(np.add(walk(0.1 * i), (0.3, 0))))])))
    assert figures["ade_m"] == pytest.approx(0, abs=1e-9)
    truth = figures["ground_truth"]
    assert truth["scored"] == 20 - P
    assert truth["ade_m"] == pytest.approx(0.3, abs=1e-6)
    assert truth["tracker"]["ade_m"] == pytest.approx(0.3, abs=1e-6)
    assert (truth["missed"], truth["false"], truth["id_switches"], truth["frames"]) == (0, 0, 0, 20)
    assert truth["localisation_m"] == pytest.approx(0.3, abs=1e-5)
    assert truth["mota"] == pytest.approx(1)


@pytest.mark.parametrize(("distance_m", "scored_"), [(MATCH_M - 0.01, 20 - P), (MATCH_M + 0.01, 0)])
def test_a_track_far_from_everybody_stands_for_nobody(drive, make, distance_m, scored_):
    figures = scored(drive(truth=lambda i: make.truth(100 * i, [(42, *(np.add(walk(0.1 * i), (0, distance_m))))])))
    assert figures["ground_truth"]["scored"] == scored_


def test_the_match_is_one_to_one_with_the_least_total_distance(make):
    """Both tracks are nearest to person 1; the second stands for person 2 all the same."""
    frames = []
    for i in range(10):
        tracks = [make.track(100 * i, 1, (0.0, 0, 0, 0)), make.track(100 * i, 2, (0.4, 0, 0, 0))]
        paths = [make.prediction(1, [[0.0, 0]] * P), make.prediction(2, [[0.4, 0]] * P)]
        frames.append(make.result(100 * i, tracks, paths, make.truth(100 * i, [(1, 0.1, 0), (2, 1.1, 0)]), sequence=i))
    truth = scored(frames)["ground_truth"]
    assert truth["scored"] == 2 * (10 - P)
    assert truth["ade_m"] == pytest.approx((0.1 + 0.7) / 2)


def test_people_with_few_points_are_neither_missed_nor_false(drive, make):
    missed = scored(make.result(100 * i, (), (), make.truth(100 * i, [(1, 3, 3)], 3)) for i in range(10))
    assert missed["ground_truth"]["missed"] == 0
    seen = scored(make.result(100 * i, (), (), make.truth(100 * i, [(1, 3, 3)], 4)) for i in range(10))
    assert seen["ground_truth"]["missed"] == 10
    tracked = scored(drive(truth=lambda i: make.truth(100 * i, [(1, *walk(0.1 * i))], 3)))
    assert tracked["ground_truth"]["false"] == 0


def test_a_track_of_nobody_is_false(drive, make):
    assert scored(drive(truth=lambda i: make.truth(100 * i)))["ground_truth"]["false"] == 20


def test_means_are_weighted_by_prediction():
    errors = Errors()
    assert errors.as_json() == {"ade_m": None, "fde_m": None, "mhd_m": None, "nll": None}
    errors.add(np.array([[1.0, 2, 3, 4]]))
    errors.add(np.array([[4.0, 5, 6, 7], [7, 8, 9, 10]]))
    assert errors.as_json() == {"ade_m": 4, "fde_m": 5, "mhd_m": 6, "nll": 7}
    assert errors.scored == 3


# --- where people were at given times --------------------------------------------------------------------------------


def at(stamp_ns, people, unmeasured=()):
    """Positions of {id: (x, y)}."""
    ids = np.array(sorted(people), np.int64)
    positions = np.array([people[id] for id in ids], float).reshape(-1, 2)
    return Positions(stamp_ns, ids, positions, ~np.isin(ids, unmeasured))


def test_each_step_is_known_by_itself():
    """Person 7 leaves after 200 ms: two steps of four are known; person 3 is there throughout, person 5 never was."""
    seen = [at(k * 100, {3: (k, 0), **({7: (0, k)} if k <= 2 else {})}) for k in range(6)]
    positions, known = lookup(seen, np.array([7, 3, 5]), np.array([50, 150, 250, 400]))
    assert known.tolist() == [[True, True, False, False], [True] * 4, [False] * 4]
    np.testing.assert_allclose(positions[0, :2], [[0, 0.5], [0, 1.5]])
    np.testing.assert_allclose(positions[1], [[0.5, 0], [1.5, 0], [2.5, 0], [4, 0]])


def test_steps_before_and_past_what_was_seen_are_not_known():
    _, known = lookup([at(100, {1: (0, 0)}), at(200, {1: (1, 0)})], np.array([1]), np.array([50, 100, 200, 250]))
    assert known.tolist() == [[False, True, True, False]]


def test_a_step_in_a_long_gap_is_not_known():
    half = MAX_GAP_NS // 2
    seen = [at(0, {1: (0, 0)}), at(MAX_GAP_NS, {1: (1, 0)}), at(2 * MAX_GAP_NS + 1, {1: (2, 0)})]
    positions, known = lookup(seen, np.array([1]), np.array([half, MAX_GAP_NS + half, 2 * MAX_GAP_NS + 1]))
    assert known.tolist() == [[True, False, True]]
    np.testing.assert_allclose(positions[0, [0, 2]], [[0.5, 0], [2, 0]])


def test_what_was_not_measured_does_not_count():
    seen = [at(0, {1: (0, 0)}), at(100, {1: (99, 0)}, unmeasured=[1]), at(200, {1: (2, 0)})]
    positions, known = lookup(seen, np.array([1]), np.array([100]))
    assert known.all()
    np.testing.assert_allclose(positions, [[[1, 0]]])


def test_everybody_may_be_asked_about_other_times():
    seen = [at(k * 100, {1: (k, 0), 2: (0, k)}) for k in range(5)]
    positions, known = lookup(seen, np.array([2, 1, 2]), np.array([[100], [250], [350]]))
    assert known.all()
    np.testing.assert_allclose(positions[:, 0], [[0, 1], [2.5, 0], [0, 3.5]])


def test_nothing_seen_or_nobody_asked_about():
    steps = np.array([100, 200])
    for seen in ([], [at(0, {})]):
        assert lookup(seen, np.array([1]), steps)[1].tolist() == [[False, False]]
    assert lookup([at(0, {1: (0, 0)})], np.zeros(0, np.int64), steps)[1].shape == (0, 2)
