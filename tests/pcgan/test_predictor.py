"""Every frame is answered: who was seen at an earlier step by the network, the others by extrapolation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcgan import checkpoint, modal_paths
from pcgan.batches import Observation
from pcgan.history import observations
from pcgan.model import POOLINGS
from pcgan.predictor import USUAL_SIGMA_M, Predictor, excess
from schemas import codec
from schemas.messages import PredictionFrame, TrackHistory, VehicleHistory, VehiclePath


@pytest.fixture
def predictor(make_generator):
    return Predictor(make_generator(), "random", "0" * 64)


def test_empty_frame_gets_an_empty_answer(predictor, make_frame):
    answer = predictor.step(make_frame(sequence=17))
    assert vars(answer) == vars(PredictionFrame(17, make_frame().stamp_ns, "odom", "random", 0.1, ()))
    assert predictor.step(make_frame(vehicle_speed_mps=2.0)).vehicle_path is not None


def test_answer_is_a_sound_message(predictor, make_frame, make_track):
    tracks = [make_track(id=i, position=(i, 2 * i), noise_m=0.02) for i in (4, 1, 9)]
    answer = predictor.step(make_frame(*tracks, vehicle_speed_mps=4.0))
    assert [p.track_id for p in answer.predictions] == [4, 1, 9]
    decoded = codec.decode(PredictionFrame, codec.encode(answer))
    for prediction, back in zip(answer.predictions, decoded.predictions, strict=True):
        assert not prediction.fallback
        probabilities = [path.probability for path in prediction.paths]
        assert probabilities == sorted(probabilities, reverse=True)
        assert sum(probabilities) == pytest.approx(1, abs=1e-6)
        assert all(path.points_m.shape == (12, 2) for path in prediction.paths)
        mixture = prediction.mixture
        assert mixture.means_m.shape == mixture.sigmas_m.shape == (12, 6, 2)
        assert {a.dtype for a in vars(mixture).values()} == {np.dtype(np.float32)}
        np.testing.assert_allclose(mixture.weights.sum(axis=1), 1, atol=1e-5)
        np.testing.assert_allclose(back.mixture.means_m, mixture.means_m)
        np.testing.assert_allclose(back.paths[0].points_m, prediction.paths[0].points_m)


def test_first_point_is_one_step_ahead(predictor, make_frame, make_track):
    (prediction,) = predictor.step(make_frame(make_track(position=(3, 4), velocity=(1.0, -0.5)))).predictions
    assert prediction.paths[0].points_m[0] == pytest.approx([3.1, 3.95], abs=0.06)
    inside = prediction.mixture.means_m.min(axis=1) - 1e-5 <= prediction.paths[0].points_m
    assert inside.all()  # the path lies among the means


def test_positions_far_from_the_origin_keep_their_precision(predictor, make_frame, make_track):
    near = predictor.step(make_frame(make_track(noise_m=0.02), make_track(id=2, position=(2, 1))))
    shift = np.array([400_000.0, 6_000_000.0])  # as in UTM

    offset = np.array([*shift, 0, 0])

    def moved(track):
        states = track.history.states + offset
        return replace(track, state=track.state + offset, history=replace(track.history, states=states))

    far = predictor.step(make_frame(moved(make_track(noise_m=0.02)), moved(make_track(id=2, position=(2, 1)))))
    for a, b in zip(near.predictions, far.predictions, strict=True):
        np.testing.assert_allclose(b.paths[0].points_m - shift, a.paths[0].points_m, atol=1e-5)


@pytest.mark.parametrize(
    "broken",
    [
        {"age_s": 0.0},  # seen once
        {"coasting": True},
        {"ages_s": [0.04, 0.0]},  # for less than a step
        {"ages_s": [3.0, 2.0, 0.0]},  # a gap of 2 s
        {"ages_s": [3.0, 2.0, 1.5]},  # nothing lately
        {"ages_s": []},
    ],
)
def test_insufficient_history_falls_back(predictor, make_frame, make_track, broken):
    good = make_track(id=1)
    bad = make_track(id=2, position=(5, 5), velocity=(0.0, 2.0), **broken)
    alone, together = predictor.step(make_frame(good)), predictor.step(make_frame(bad, good))
    fallback, predicted = together.predictions
    assert (fallback.track_id, fallback.fallback) == (2, True)
    assert not predicted.fallback
    assert len(fallback.paths) == 1
    assert fallback.paths[0].probability == 1
    np.testing.assert_allclose(fallback.paths[0].points_m[-1], [5, 5 + 2 * 1.2])
    assert fallback.mixture.means_m.shape == (12, 1, 2)
    np.testing.assert_array_equal(predicted.paths[0].points_m, alone.predictions[0].paths[0].points_m)
    codec.decode(PredictionFrame, codec.encode(together))


HISTORIES = [
    *({"age_s": steps / 10} for steps in range(1, 8)),  # 2 to 8 steps
    {"ages_s": [0.15, 0.0]},  # between the steps: one interpolated, and now
    {"ages_s": [0.9, 0.0]},  # a gap that may be bridged
    {"ages_s": [0.7, 0.6, 0.3, 0.1, 0.0]},  # gaps in between
    {"ages_s": [3.0, 2.0, 0.2, 0.1, 0.0]},  # a gap that is none of this observation's
    {"ages_s": [3.0, 2.9, 2.8, 1.7, 0.2, 0.1]},  # the last scan missed
]


def test_histories_of_all_lengths_and_with_gaps_are_predicted_in_one_frame(predictor, make_frame, make_track):
    tracks = [make_track(id=i, position=(2 * i, i), **history) for i, history in enumerate(HISTORIES)]
    answer = predictor.step(make_frame(*tracks, vehicle_speed_mps=4.0))
    assert [p.track_id for p in answer.predictions] == list(range(len(HISTORIES)))
    for track, prediction in zip(tracks, answer.predictions, strict=True):
        assert not prediction.fallback
        assert prediction.mixture.means_m.shape == (12, 6, 2)
        ahead = track.state[:2] + 0.1 * np.arange(1, 13)[:, None] * track.state[2:]
        assert np.abs(prediction.paths[0].points_m - ahead).max() < 1
    codec.decode(PredictionFrame, codec.encode(answer))


def test_missed_scan_is_predicted_until_the_track_coasts(predictor, make_frame, make_track):
    """The last sample of the history is a coasted one; the track's state is its present all the same."""
    track = make_track(position=(3, 4), noise_m=0.02)
    last = np.arange(len(track.history.stamps_ns)) == len(track.history.stamps_ns) - 1
    states = np.where(last[:, None], 99.0, track.history.states)  # where it coasted to must not matter
    coasted_once = TrackHistory(track.history.stamps_ns, states, last)
    ended = TrackHistory(track.history.stamps_ns[:-1], states[:-1], last[:-1])
    for history in (coasted_once, ended):
        (prediction,) = predictor.step(make_frame(replace(track, history=history))).predictions
        assert not prediction.fallback
        np.testing.assert_allclose(prediction.paths[0].points_m[0], [3.12, 4], atol=0.06)
        (coasted,) = predictor.step(make_frame(replace(track, history=history, coasting=True))).predictions
        assert coasted.fallback


def test_short_gap_is_interpolated(predictor, make_frame, make_track):
    whole = predictor.step(make_frame(make_track())).predictions[0]
    gap = predictor.step(make_frame(make_track(ages_s=[0.9, 0.8, 0.7, 0.2, 0.1, 0.0]))).predictions[0]
    assert not gap.fallback
    np.testing.assert_allclose(gap.paths[0].points_m, whole.paths[0].points_m, atol=1e-6)


def test_vehicle_changes_the_answer_and_may_be_missing(predictor, make_frame, make_track):
    track = make_track(velocity=(0.0, -1.0))
    without = predictor.step(make_frame(track)).predictions[0]
    with_vehicle = predictor.step(make_frame(track, vehicle_speed_mps=5.0)).predictions[0]
    assert not np.array_equal(without.mixture.means_m, with_vehicle.mixture.means_m)
    frame = make_frame(track, vehicle_speed_mps=5.0)
    h = frame.vehicle_history
    short = replace(frame, vehicle_history=VehicleHistory(h.stamps_ns[-5:], h.states[-5:]))
    np.testing.assert_array_equal(predictor.step(short).predictions[0].mixture.means_m, without.mixture.means_m)


def test_answers_are_equal_bit_for_bit(predictor, make_frame, make_track, make_generator):
    tracks = [make_track(id=i, position=(i % 7, i // 7), velocity=(1, 0.1 * i), noise_m=0.03) for i in range(30)]
    frame = make_frame(*tracks, make_track(id=50, age_s=0.2), make_track(id=51, age_s=0.0), vehicle_speed_mps=3.0)
    first = codec.encode(predictor.step(frame))
    predictor.step(make_frame(make_track(id=3, position=(100, 2))))  # another frame in between leaves no trace
    assert codec.encode(predictor.step(frame)) == first
    assert codec.encode(Predictor(make_generator(), "random", "").step(frame)) == first


def test_slow_model_reads_a_longer_history(make_generator, make_frame, make_track):
    predictor = Predictor(make_generator(dt_s=0.4), "slow", "")
    answer = predictor.step(make_frame(*(make_track(id=i, age_s=age) for i, age in enumerate((0.3, 0.4, 2.7, 2.8)))))
    assert [p.fallback for p in answer.predictions] == [True, False, False, False]
    assert answer.dt_s == 0.4


def test_paper_recipe_is_served_too(make_generator, make_frame, make_track):
    predictor = Predictor(make_generator(recipe="paper"), "paper", "")
    (prediction,) = predictor.step(make_frame(make_track(position=(1000, 0)), vehicle_speed_mps=2.0)).predictions
    assert abs(prediction.paths[0].points_m[:, 0] - 1000).max() < 5


def test_from_checkpoint_knows_its_file(tmp_path, make_generator, make_frame, make_track):
    generator = make_generator()
    path = tmp_path / "campus.safetensors"
    checkpoint.save(path, generator.config, generator.state_dict(), {})
    loaded = Predictor.from_checkpoint(path)
    assert loaded.model_name == "campus"
    assert loaded.checksum == checkpoint.sha256(path)
    assert loaded.dt_s == 0.1
    frame = make_frame(make_track(noise_m=0.05))
    expected = Predictor(generator, "campus", "").step(frame)
    assert codec.encode(loaded.step(frame)) == codec.encode(expected)


def torch_answer(generator, frame):
    """The mixture and the modal paths that torch gives for a frame whose tracks are all predicted."""
    times_ns = frame.stamp_ns - (np.arange(7, -1, -1) * generator.config.dt_s * 1e9).round().astype(np.int64)
    positions, seen, usable = observations(frame.tracks, times_ns)
    assert usable.all()
    A = len(frame.tracks)
    vehicle = None
    if len(frame.vehicle_history.stamps_ns):
        driven = frame.vehicle_history.states[-8:, [0, 1, 3, 4]]
        vehicle = torch.tensor(driven, dtype=torch.float32).expand(A, 8, 4)
    observation = Observation(
        observed=torch.tensor(positions, dtype=torch.float32),
        seen=torch.from_numpy(seen),
        velocity=torch.tensor(np.array([track.state[2:] for track in frame.tracks]), dtype=torch.float32),
        neighbours=torch.ones(A, A, dtype=torch.bool),
        vehicle=vehicle,
    )
    with torch.inference_mode():
        mixture = generator(observation)
        return mixture, modal_paths.modal_paths(mixture.weights, mixture.means, generator.config.eps_m)


NETWORKS = [("best", pooling) for pooling in POOLINGS] + [("paper", "gvat")]


@pytest.mark.parametrize(("recipe", "pooling"), NETWORKS)
@pytest.mark.parametrize("vehicle_speed_mps", [4.0, None])
@pytest.mark.parametrize("A", [1, 2, 30])
def test_answer_is_the_torch_generators(make_generator, make_frame, make_track, recipe, pooling, vehicle_speed_mps, A):
    """Histories of 2 to 8 steps among them."""
    tracks = [make_track(id=i, position=(i % 7, i // 7), velocity=(1 - 0.1 * i, 0.5), noise_m=0.03,
                         age_s=0.7 - i % 7 / 10) for i in range(A)]  # fmt: skip
    frame = make_frame(*tracks, vehicle_speed_mps=vehicle_speed_mps)
    generator = make_generator(recipe=recipe, pooling=pooling)
    with torch.no_grad():
        generator.phi_mdn.weight.mul_(8)  # components that lie apart
    predictions = Predictor(generator, "random", "").step(frame).predictions
    mixture, paths = torch_answer(generator, frame)
    more = 0.1**2 - USUAL_SIGMA_M**2  # of the made tracks, on each axis
    sigmas = (mixture.log_sigmas.exp().square() + more).sqrt()
    rhos = mixture.rhos * (mixture.log_sigmas.exp() / sigmas).prod(dim=-1)
    for i, prediction in enumerate(predictions):
        np.testing.assert_allclose(prediction.mixture.weights, mixture.weights[i], atol=1e-5)
        np.testing.assert_allclose(prediction.mixture.means_m, mixture.means[i], atol=1e-5)
        np.testing.assert_allclose(prediction.mixture.sigmas_m, sigmas[i], atol=1e-5)
        np.testing.assert_allclose(prediction.mixture.rhos, rhos[i], atol=1e-4)
        assert len(prediction.paths) == (paths.probabilities[i] > 0).sum()
        for path, probability, points in zip(prediction.paths, paths.probabilities[i], paths.points[i], strict=False):
            assert path.probability == pytest.approx(probability.item(), abs=1e-5)
            np.testing.assert_allclose(path.points_m, points, atol=2e-5)
    assert A < 30 or max(len(prediction.paths) for prediction in predictions) > 1


def test_crowd_of_five_hundred_is_answered_as_torch_does(make_generator, make_frame, make_track):
    rng = np.random.default_rng(0)
    walks = zip(rng.uniform(-40, 40, (500, 2)), rng.normal(0, 1, (500, 2)), rng.integers(1, 8, 500), strict=True)
    tracks = [make_track(id=i, position=p, velocity=v, age_s=steps / 10) for i, (p, v, steps) in enumerate(walks)]
    frame, generator = make_frame(*tracks, vehicle_speed_mps=4.0), make_generator()
    predictions = Predictor(generator, "random", "").step(frame).predictions
    mixture, _ = torch_answer(generator, frame)
    means = np.array([prediction.mixture.means_m for prediction in predictions])
    np.testing.assert_allclose(means, mixture.means, atol=3e-5)
    assert all(np.isfinite(prediction.mixture.sigmas_m).all() for prediction in predictions)


def test_reordered_tracks_get_their_own_answers(predictor, make_frame, make_track):
    tracks = [make_track(id=i, position=(2 * i, i), velocity=(1, -0.3 * i), age_s=(i % 4) / 5) for i in range(8)]
    straight = {p.track_id: p for p in predictor.step(make_frame(*tracks)).predictions}
    for prediction in predictor.step(make_frame(*(tracks[i] for i in (3, 0, 7, 4, 2, 6, 1, 5)))).predictions:
        assert prediction.fallback == straight[prediction.track_id].fallback
        wanted = straight[prediction.track_id].mixture
        np.testing.assert_allclose(prediction.mixture.means_m, wanted.means_m, atol=1e-5)


# --- tracks that are known worse than usual --------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.0, 0.6, -0.6, 2.0])
def test_excess_is_what_a_covariance_has_beyond_the_usual_in_each_direction(angle):
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s], [s, c]])
    better, wide = 0.5 * USUAL_SIGMA_M**2, 0.25
    covariances = np.array([better * np.eye(2), turn @ np.diag([wide, better]) @ turn.T])
    found = excess(covariances)
    np.testing.assert_allclose(found[0], 0, atol=1e-12)
    np.testing.assert_allclose(found[1], turn @ np.diag([wide - USUAL_SIGMA_M**2, 0]) @ turn.T, atol=1e-12)


def test_badly_known_track_has_a_wider_mixture_around_the_same_path(predictor, make_frame, make_track):
    def sigmas(variances):
        covariance = np.diag([*variances, 0.04, 0.04])
        track = replace(make_track(noise_m=0.02), covariance=covariance)
        (prediction,) = predictor.step(make_frame(track)).predictions
        return prediction.mixture.sigmas_m, prediction.paths[0].points_m

    usual, path = sigmas([USUAL_SIGMA_M**2] * 2)
    better, _ = sigmas([1e-4, 1e-4])
    worse, same_path = sigmas([0.5, 1e-4])
    np.testing.assert_allclose(better, usual, rtol=1e-5)
    np.testing.assert_array_equal(same_path, path)
    np.testing.assert_allclose(worse[..., 0], np.sqrt(usual[..., 0] ** 2 + 0.5 - USUAL_SIGMA_M**2), rtol=1e-5)
    np.testing.assert_allclose(worse[..., 1], usual[..., 1], rtol=1e-5)


# --- the vehicle's corridor ------------------------------------------------------------------------------------------


def risks(answer):
    return [(p.corridor_probability, p.corridor_time_s) for p in answer.predictions]


def test_corridor_is_the_present_motion_carried_on(predictor, make_frame, make_track):
    """At 4 m/s along y = -3: one stands ahead, one aside, one behind; the horizon is 1.2 s."""
    places = {1: (5, -3), 2: (5, 3), 3: (-4, -3), 4: (2.4 + 4.8 + 2, -3)}
    tracks = [make_track(id=i, position=place, velocity=(0, 0)) for i, place in places.items()]
    answer = predictor.step(make_frame(*tracks, vehicle_speed_mps=4.0))
    (ahead, now_s), *others = risks(answer)
    assert ahead == pytest.approx(1, abs=1e-6)
    assert now_s == pytest.approx(0, abs=0.01)
    assert others == [(0, None)] * 3
    path = answer.vehicle_path
    np.testing.assert_allclose(path.times_s, 0.1 * np.arange(13))
    np.testing.assert_allclose(path.poses, [[0.4 * i, -3, 0] for i in range(13)], atol=1e-9)
    decoded = codec.decode(PredictionFrame, codec.encode(answer))
    assert risks(decoded) == risks(answer)
    np.testing.assert_array_equal(decoded.vehicle_path.poses, path.poses)


def test_given_path_changes_the_corridor_and_nothing_else(predictor, make_frame, make_track):
    tracks = [make_track(id=1, position=(5, -3), velocity=(0, 0)), make_track(id=2, position=(0, 1), age_s=0.0)]
    frame = make_frame(*tracks, vehicle_speed_mps=4.0)
    to_the_left = VehiclePath(np.array([0, 1.2]), np.array([[0, -3, 1.57], [0, 3, 1.57]]), 2.4, 0.6, 1.4)
    driven_on, supposed = predictor.step(frame), predictor.step(replace(frame, vehicle_path=to_the_left))
    assert [p > 0.99 for p, _ in risks(driven_on)] == [True, False]
    assert [p > 0.99 for p, _ in risks(supposed)] == [False, True]  # the fallback has figures, too
    assert supposed.vehicle_path is to_the_left
    plain = [replace(p, corridor_probability=0, corridor_time_s=None) for p in driven_on.predictions]
    same = [replace(p, corridor_probability=0, corridor_time_s=None) for p in supposed.predictions]
    assert codec.encode(replace(driven_on, predictions=tuple(plain), vehicle_path=None)) == codec.encode(
        replace(supposed, predictions=tuple(same), vehicle_path=None)
    )


def test_without_a_vehicle_nobody_enters_unless_a_path_is_given(predictor, make_frame, make_track):
    frame = make_frame(make_track(velocity=(0, 0)))
    answer = predictor.step(frame)
    assert (risks(answer), answer.vehicle_path) == ([(0, None)], None)
    standing = VehiclePath(np.zeros(1), np.zeros((1, 3)), 2.4, 0.6, 1.4)
    [(probability, time_s)] = risks(predictor.step(replace(frame, vehicle_path=standing)))
    assert probability == pytest.approx(1, abs=1e-6)
    assert time_s == pytest.approx(0, abs=0.01)


def test_crossing_in_time_is_expected_when_it_happens(make_generator, make_frame, make_track):
    """The fallback walks straight on: 2 m/s towards the edge at y = -2, from 2 m away."""
    predictor = Predictor(make_generator(), "random", "")
    track = make_track(position=(6, 0), velocity=(0, -2), age_s=0.0)
    track = replace(track, covariance=1e-6 * np.eye(4))
    [(probability, time_s)] = risks(predictor.step(make_frame(track, vehicle_speed_mps=4.0)))
    assert probability > 0.75  # 0.2 s are left, and it may slow down
    assert time_s == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("broken", [np.nan, np.inf])
def test_path_that_is_not_finite_is_refused(predictor, make_frame, make_track, broken):
    for path in (
        VehiclePath(np.array([0, broken]), np.zeros((2, 3)), 2.4, 0.6, 1.4),
        VehiclePath(np.zeros(1), np.array([[broken, 0, 0]]), 2.4, 0.6, 1.4),
        VehiclePath(np.zeros(0), np.zeros((0, 3)), 2.4, 0.6, 1.4),
        VehiclePath(np.zeros(1), np.zeros((1, 3)), 2.4, 0.6, broken),
    ):
        with pytest.raises(ValueError, match="the vehicle's path has no poses, or holds NaN or infinity"):
            predictor.step(replace(make_frame(make_track()), vehicle_path=path))


# --- what is not finite ----------------------------------------------------------------------------------------------


def with_sample(track, age_steps, value):
    states = track.history.states.copy()
    states[-1 - age_steps, 0] = value
    return replace(track, history=replace(track.history, states=states))


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("coasting", [False, True])
def test_track_that_is_not_finite_is_refused_by_name(predictor, make_frame, make_track, value, coasting):
    """Wherever it is needed: in the observed history, the present state, the covariance."""
    good, track = make_track(id=3), make_track(id=8, coasting=coasting)
    covariance = track.covariance.copy()
    covariance[2, 2] = value
    for bad in (
        with_sample(track, 2, value),
        replace(track, state=np.array([0, 0, value, 0])),
        replace(track, covariance=covariance),
    ):
        with pytest.raises(ValueError, match=r"tracks \[8\] hold NaN or infinity"):
            predictor.step(make_frame(good, bad, good))


def test_what_is_not_needed_may_be_anything(predictor, make_frame, make_track):
    """Samples older than the observation, and the vehicle: then there is none."""
    track = make_track(velocity=(0.0, -1.0), noise_m=0.02)
    frame = make_frame(track, vehicle_speed_mps=5.0)
    old = predictor.step(replace(frame, tracks=(with_sample(track, 20, np.nan),)))
    assert codec.encode(old) == codec.encode(predictor.step(frame))
    states = frame.vehicle_history.states.copy()
    states[-3] = np.nan
    gone = predictor.step(replace(frame, vehicle_history=replace(frame.vehicle_history, states=states)))
    assert codec.encode(gone) == codec.encode(predictor.step(make_frame(track)))


def test_training_on_changes_no_predictor(make_generator, make_frame, make_track):
    generator, frame = make_generator(), make_frame(make_track(noise_m=0.02))
    predictor = Predictor(generator, "random", "")
    before = codec.encode(predictor.step(frame))
    with torch.no_grad():
        for weights in generator.parameters():
            weights.add_(0.1)
    assert codec.encode(predictor.step(frame)) == before
