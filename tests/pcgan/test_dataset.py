"""Windows cut from made clips, and the split of the public ones."""

import numpy as np
import pytest

from pcgan import dataset
from pcgan.clips import Clip
from pcgan.dataset import WindowSpec, clip_windows, concatenate, weighted_velocity

SPEC = WindowSpec(observed_steps=8, predicted_steps=12, dt_s=0.1, stride_s=0.1)


def test_weighted_velocity_of_a_straight_walk():
    walk = np.arange(8)[:, None] * [0.1, -0.2]
    np.testing.assert_allclose(weighted_velocity(walk, 0.1), [1, -2])


def test_weighted_velocity_halves_with_age():
    steps = np.array([[0.0, 0], [1, 0], [1, 0], [4, 0]])  # displacements 1, 0, 3; weights 1/7, 2/7, 4/7
    np.testing.assert_allclose(weighted_velocity(steps, 1.0), [13 / 7, 0])


def test_windows_continue_the_trajectory(make_clip):
    clip = make_clip(pedestrians=3, vehicles=0, frames=72)  # 71 / 24 s: 30 grid steps
    windows = clip_windows(clip, SPEC)
    assert windows.observed.shape[1:] == (8, 2)
    assert windows.scene[-1] + 1 == 30 - 20 + 1
    assert windows.known.all()
    step = np.linalg.norm(np.diff(np.concatenate([windows.observed, windows.future], 1), axis=1), axis=-1)
    assert step.max() < 0.17  # nobody jumps: at most 1.6 m/s
    assert step.min() > 0.07
    np.testing.assert_allclose(np.linalg.norm(windows.velocity, axis=1), step[:, 6] / 0.1, rtol=0.03)


def test_windows_are_interpolated_on_the_grid(make_clip):
    clip = make_clip(pedestrians=1, vehicles=0, frames=60, rate_hz=29.97)
    walker = clip.pedestrians[0]
    windows = clip_windows(clip, SPEC)
    times = walker.frames / clip.rate_hz
    grid = times[0] + 0.1 * np.arange(8)
    expected = np.stack([np.interp(grid, times, walker.positions_m[:, axis]) for axis in (0, 1)], -1)
    np.testing.assert_allclose(windows.observed[0], expected - expected[-1], atol=1e-6)


def test_scene_origin_is_the_mean_present_position(make_clip):
    windows = clip_windows(make_clip(), SPEC)
    for scene in (0, int(windows.scene[-1])):
        np.testing.assert_allclose(windows.observed[windows.scene == scene, -1].mean(axis=0), 0, atol=1e-5)


def test_pedestrian_who_leaves_is_a_neighbour_without_future(make_clip):
    clip = make_clip(pedestrians=2, vehicles=0, frames=72)
    leaving = clip.pedestrians[1]
    cut = type(leaving)(leaving.id, leaving.frames[:30], leaving.positions_m[:30], leaving.velocities_mps[:30])
    windows = clip_windows(Clip(clip.name, clip.rate_hz, (clip.pedestrians[0], cut), ()), SPEC)
    assert (windows.scene == 0).sum() == 2
    assert windows.known[windows.scene == 0].tolist() == [True, False]


def test_each_pedestrian_sees_its_nearest_vehicle(make_clip):
    clip = make_clip(pedestrians=8, vehicles=3, frames=60)
    windows = clip_windows(clip, SPEC)
    far = np.linalg.norm(windows.vehicle[:, -1, :2] - windows.observed[:, -1], axis=-1)
    np.testing.assert_allclose(windows.vehicle[:, :, 2], 4.0, atol=1e-6)
    assert np.allclose(np.diff(windows.vehicle[:, :, 0], axis=1), 0.4, atol=1e-4)
    gaps = windows.vehicle[:, -1, 1] - windows.observed[:, -1, 1]
    assert len(np.unique(np.round(windows.vehicle[windows.scene == 0, -1, 1], 3))) > 1
    assert (np.abs(gaps) <= far + 1e-6).all()
    assert np.isnan(clip_windows(make_clip(vehicles=0), SPEC).vehicle).all()


def test_slow_model_has_windows_at_the_scan_rate(make_clip):
    spec = WindowSpec(8, 4, 0.4, 0.1)
    windows = clip_windows(make_clip(frames=24 * 6, vehicles=0), spec)
    assert windows.scene[-1] + 1 == (60 - 1) - 11 * 4 + 1
    np.testing.assert_allclose(
        np.linalg.norm(np.diff(windows.observed, axis=1), axis=-1).max(), 0.64, atol=0.1
    )  # 1.6 m/s for 0.4 s


def test_filtered_windows_are_near_the_truth_and_smoother_than_noise(make_clip):
    clip = make_clip(pedestrians=40, vehicles=1, frames=24 * 8)
    rng = np.random.default_rng(0)
    windows = clip_windows(clip, SPEC, noise_m=0.05, rng=rng)
    ahead = windows.observed[:, -1:] + windows.velocity[:, None] * 0.1
    error = np.linalg.norm(ahead - windows.future[:, :1], axis=-1)
    assert 0.01 < np.median(error) < 0.08
    jitter = np.std(np.diff(windows.observed, n=2, axis=1))
    assert jitter < 0.05 * 6**0.5 / 2  # white noise of 5 cm would have 0.05 sqrt(6)
    assert not windows.annotated.any()
    with pytest.raises(ValueError, match="rng"):
        clip_windows(clip, SPEC, noise_m=0.05)


def test_clip_too_short_gives_no_windows(make_clip):
    assert len(clip_windows(make_clip(frames=10), SPEC)) == 0
    assert len(clip_windows(Clip("dut/empty", 24.0, (), ()), SPEC)) == 0


def test_concatenated_scenes_are_numbered_on(make_clip):
    one, two = clip_windows(make_clip(seed=1), SPEC), clip_windows(make_clip(seed=2), SPEC)
    both = concatenate([one, clip_windows(make_clip(frames=5), SPEC), two])
    assert len(both) == len(one) + len(two)
    assert len(np.unique(both.scene)) == len(np.unique(one.scene)) + len(np.unique(two.scene))
    assert (np.diff(both.scene) >= 0).all()


def test_held_out_clips_are_refused():
    dataset.refuse_held_out(("dut/roundabout_02",))
    with pytest.raises(ValueError, match="citr/p2p_uni/walk_01, dut/intersection_08"):
        dataset.refuse_held_out(("dut/intersection_08", "citr/p2p_uni/walk_01"))


def test_split_of_the_public_clips_does_not_overlap(public_data):
    training = dataset.training_clip_names(public_data)
    assert len(training) == 27 - len(dataset.HELD_OUT_CLIPS) - len(dataset.VALIDATION_CLIPS)
    assert not set(training) & (set(dataset.HELD_OUT_CLIPS) | set(dataset.VALIDATION_CLIPS))
    dataset.refuse_held_out(training + dataset.VALIDATION_CLIPS)
