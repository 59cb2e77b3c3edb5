"""Every frame is answered; who was seen long enough by the network, the others by extrapolation."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcgan import checkpoint, modal_paths
from pcgan.predictor import Predictor
from schemas import codec
from schemas.messages import PredictionFrame, VehicleHistory


@pytest.fixture
def predictor(make_generator):
    return Predictor(make_generator(), "random", "0" * 64)


def test_empty_frame_gets_an_empty_answer(predictor, make_frame):
    answer = predictor.step(make_frame(sequence=17))
    assert vars(answer) == vars(PredictionFrame(17, make_frame().stamp_ns, "odom", "random", 0.1, ()))


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
        {"age_s": 0.6},  # the network needs 0.7 s
        {"coasting": True},
        {"ages_s": [3.0, 2.9, 2.8, 1.7, 0.2, 0.1]},  # nothing now
        {"ages_s": [3.0, 2.0, 0.2, 0.1, 0.0]},  # a gap of 1.8 s
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
    frame = make_frame(*tracks, make_track(id=50, age_s=0.2), vehicle_speed_mps=3.0)
    first = codec.encode(predictor.step(frame))
    predictor.step(make_frame(make_track(id=3, position=(100, 2))))  # another frame in between leaves no trace
    assert codec.encode(predictor.step(frame)) == first
    assert codec.encode(Predictor(make_generator(), "random", "").step(frame)) == first


def test_slow_model_reads_a_longer_history(make_generator, make_frame, make_track):
    predictor = Predictor(make_generator(dt_s=0.4), "slow", "")
    answer = predictor.step(make_frame(make_track(id=1, age_s=2.7), make_track(id=2, age_s=2.8)))
    assert [p.fallback for p in answer.predictions] == [True, False]
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


@pytest.mark.parametrize("recipe", ["best", "paper"])
@pytest.mark.parametrize("vehicle_speed_mps", [4.0, None])
def test_answer_is_the_torch_generators(make_generator, make_frame, make_track, recipe, vehicle_speed_mps):
    tracks = [make_track(id=i, position=(i % 7, i // 7), velocity=(1 - 0.1 * i, 0.5), noise_m=0.03) for i in range(30)]
    frame = make_frame(*tracks, vehicle_speed_mps=vehicle_speed_mps)
    generator = make_generator(recipe=recipe)
    predictions = Predictor(generator, "random", "").step(frame).predictions

    states = torch.tensor(np.array([track.history.states[-8:] for track in tracks]), dtype=torch.float32)
    velocity = torch.tensor(np.array([track.state[2:] for track in tracks]), dtype=torch.float32)
    vehicle = None
    if vehicle_speed_mps is not None:
        vehicle = torch.tensor(frame.vehicle_history.states[-8:, [0, 1, 3, 4]], dtype=torch.float32)
    everyone = torch.ones(30, 30, dtype=torch.bool)
    with torch.inference_mode():
        mixture = generator(states[..., :2], velocity, everyone, vehicle)
        paths = modal_paths.modal_paths(mixture.weights, mixture.means, generator.config.eps_m)
    for i, prediction in enumerate(predictions):
        np.testing.assert_allclose(prediction.mixture.weights, mixture.weights[i], atol=1e-5)
        np.testing.assert_allclose(prediction.mixture.means_m, mixture.means[i], atol=1e-5)
        np.testing.assert_allclose(prediction.mixture.sigmas_m, mixture.log_sigmas[i].exp(), atol=1e-5)
        np.testing.assert_allclose(prediction.mixture.rhos, mixture.rhos[i], atol=1e-5)
        assert len(prediction.paths) == (paths.probabilities[i] > 0).sum()
        for path, probability, points in zip(prediction.paths, paths.probabilities[i], paths.points[i], strict=False):
            assert path.probability == pytest.approx(probability.item(), abs=1e-5)
            np.testing.assert_allclose(path.points_m, points, atol=1e-5)
    assert max(len(prediction.paths) for prediction in predictions) > 1


def test_training_on_changes_no_predictor(make_generator, make_frame, make_track):
    generator, frame = make_generator(), make_frame(make_track(noise_m=0.02))
    predictor = Predictor(generator, "random", "")
    before = codec.encode(predictor.step(frame))
    with torch.no_grad():
        for weights in generator.parameters():
            weights.add_(0.1)
    assert codec.encode(predictor.step(frame)) == before
