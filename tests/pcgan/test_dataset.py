"""Windows cut from made clips, and the split of the public ones."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pcgan import dataset
from pcgan.clips import Clip
from pcgan.dataset import WindowSpec, clip_windows, concatenate, filled_in, reversed_in_time, weighted_velocity

SPEC = WindowSpec(observed_steps=8, predicted_steps=12, dt_s=0.1, stride_s=0.1)


def test_weighted_velocity_of_a_straight_walk():
    walk = np.arange(8)[:, None] * [0.1, -0.2]
    np.testing.assert_allclose(weighted_velocity(walk, 0.1), [1, -2])


def test_weighted_velocity_halves_with_age():
    steps = np.array([[0.0, 0], [1, 0], [1, 0], [4, 0]])  # displacements 1, 0, 3; weights 1/7, 2/7, 4/7
    np.testing.assert_allclose(weighted_velocity(steps, 1.0), [13 / 7, 0])


def masks(length=8):
    """Who was seen when: at the last step, and at an earlier one."""
    return st.lists(st.booleans(), min_size=length - 1, max_size=length - 1).filter(any).map(lambda m: [*m, True])


@given(st.lists(masks(), min_size=1, max_size=4), st.integers(0, 99))
def test_weighted_velocity_counts_from_the_first_seen_step_as_a_plain_loop(seen, seed):
    walks = np.random.default_rng(seed).normal(size=(len(seen), 8, 2))
    for walk, mask, found in zip(walks, seen, weighted_velocity(walks, 0.4, np.array(seen)), strict=True):
        total, weights = np.zeros(2), 0.0
        for step in range(7):
            if step >= mask.index(True):
                weight = 0.5 ** (6 - step)
                total, weights = total + weight * (walk[step + 1] - walk[step]) / 0.4, weights + weight
        np.testing.assert_allclose(found, total / weights, rtol=1e-12, atol=1e-12)


@given(st.lists(masks(), min_size=1, max_size=4), st.integers(0, 99))
def test_unseen_steps_are_filled_in_as_by_a_plain_loop(seen, seed):
    walks = np.random.default_rng(seed).normal(size=(len(seen), 8, 2))
    unseen = np.where(np.array(seen)[..., None], walks, np.nan)
    for walk, mask, found in zip(walks, seen, filled_in(unseen, np.array(seen)), strict=True):
        steps = np.flatnonzero(mask)
        expected = np.stack([np.interp(np.arange(8), steps, walk[steps, axis]) for axis in (0, 1)], axis=-1)
        np.testing.assert_allclose(found, expected, atol=1e-12)


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
    stays, leaves = windows.known[windows.scene == 0]
    assert stays.all()
    assert leaves.tolist() == [True] * 5 + [False] * 7  # 29 / 24 s are 12 steps, 7 of them observed
    together = windows.scene == 5  # the present is step 12
    assert together.sum() == 2
    assert not windows.known[together][1].any()
    assert (windows.scene == 6).sum() == 1  # gone


def arriving(make_clip, frames=96):
    """A clip of two people; the second is there from 1 s on."""
    clip = make_clip(pedestrians=2, vehicles=0, frames=frames)
    first, late = clip.pedestrians
    late = replace(
        late, frames=late.frames[24:], positions_m=late.positions_m[24:], velocities_mps=late.velocities_mps[24:]
    )
    return replace(clip, pedestrians=(first, late))


def test_pedestrian_who_arrives_is_there_from_its_second_step_on(make_clip):
    windows = clip_windows(arriving(make_clip), SPEC)
    assert (np.bincount(windows.scene)[:4] == 1).all()  # the present of scene 3 is step 10, where the second comes in
    for scene, steps in ((4, 2), (5, 3), (9, 7)):
        here = windows.select(windows.scene == scene)
        assert here.complete.tolist() == [True, False]
        assert here.seen[1].tolist() == [False] * (8 - steps) + [True] * steps
        np.testing.assert_array_equal(
            here.observed[1, : 8 - steps], np.tile(here.observed[1, 8 - steps], (8 - steps, 1))
        )
        seen = here.observed[1, 8 - steps :].astype(float)
        np.testing.assert_allclose(here.velocity[1], weighted_velocity(seen, 0.1), atol=1e-4)
        assert here.known.all()
    assert windows.select(windows.scene == 10).complete.all()


def test_scene_is_kept_if_somebody_is_known_far_enough(make_clip):
    clip = make_clip(pedestrians=3, vehicles=0, frames=72)  # grid steps 0 to 29
    counts = [clip_windows(clip, replace(SPEC, known_steps=steps)).scene[-1] + 1 for steps in (None, 12, 8, 1)]
    assert counts == [11, 11, 15, 22]
    last = clip_windows(clip, replace(SPEC, known_steps=8))
    assert last.known[last.scene == 14].sum(axis=1).tolist() == [8, 8, 8]


def test_scenes_with_more_vehicles_are_left_out_whole(make_clip):
    """Two vehicles, the second one there from 2 s on: nobody's twenty steps may reach that far."""
    clip = make_clip(pedestrians=2, vehicles=2, frames=96)
    first, second = clip.vehicles
    second = replace(
        second,
        frames=second.frames[48:],
        positions_m=second.positions_m[48:],
        yaw_rad=second.yaw_rad[48:],
        speed_mps=second.speed_mps[48:],
    )
    clip = replace(clip, vehicles=(first, second))
    assert clip_windows(clip, SPEC).scene[-1] + 1 == 40 - 19
    assert clip_windows(clip, replace(SPEC, most_vehicles=2)).scene[-1] + 1 == 40 - 19
    one = clip_windows(clip, replace(SPEC, most_vehicles=1))
    assert one.scene[-1] + 1 == 1  # steps 0 to 19 alone: the second comes in at step 20
    assert len(clip_windows(clip, replace(SPEC, most_vehicles=0))) == 0


def test_selected_windows_are_numbered_anew(make_windows):
    windows = make_windows((2, 1, 3), gaps=True)
    rows = np.array([False, True, False, True, False, True])
    chosen = windows.select(rows)
    assert chosen.scene.tolist() == [0, 1, 1]
    for name in ("observed", "seen", "velocity", "future", "vehicle", "annotated"):
        np.testing.assert_array_equal(getattr(chosen, name), getattr(windows, name)[rows])
    assert len(windows.select(np.zeros(6, bool))) == 0


# --- backwards in time -----------------------------------------------------------------------------------------------


def test_straight_walk_backwards_is_a_straight_walk_back():
    """1.2 m/s along x, 0.4 s a step: the present is the future's step 12, and the future ends where the walk began."""
    walk = np.arange(20)[:, None] * [0.48, 0.0]
    windows = dataset.centred(
        observed=walk[None, :8],
        seen=np.ones((1, 8), bool),
        velocity=np.array([[1.2, 0.0]]),
        future=walk[None, 8:],
        vehicle=np.ones((1, 8, 4)),
        scene=np.zeros(1, np.int64),
        annotated=np.ones(1, bool),
        dt_s=0.4,
    )
    back = reversed_in_time(windows)
    np.testing.assert_allclose(back.observed[0, :, 0], 0.48 * np.arange(7, -1, -1), atol=1e-6)
    np.testing.assert_allclose(back.future[0, :, 0], -0.48 * np.arange(1, 13), atol=1e-5)
    np.testing.assert_allclose(back.velocity, [[-1.2, 0]], atol=1e-6)
    assert np.isnan(back.vehicle).all()


def test_backwards_twice_is_forwards(make_clip):
    windows = clip_windows(make_clip(pedestrians=5, vehicles=1, frames=80), SPEC)
    again = reversed_in_time(reversed_in_time(windows))
    for name in ("observed", "velocity", "future"):
        np.testing.assert_allclose(getattr(again, name), getattr(windows, name), atol=1e-4, err_msg=name)
    for name in ("seen", "scene", "annotated"):
        np.testing.assert_array_equal(getattr(again, name), getattr(windows, name), err_msg=name)


def test_backwards_whoever_left_has_not_come_yet(make_windows):
    windows = make_windows((3, 4, 2, 5), gaps=True, seed=3)
    back = reversed_in_time(windows)
    there = np.concatenate([windows.seen, windows.known], axis=1)  # (N, 20)
    wanted = there[:, 12] & (there[:, 12:].sum(axis=1) >= 2)
    assert 0 < wanted.sum() < len(windows)
    np.testing.assert_array_equal(back.seen, there[wanted][:, :11:-1])
    np.testing.assert_array_equal(back.known, there[wanted][:, 11::-1])
    np.testing.assert_array_equal(np.diff(back.scene) > 0, np.diff(windows.scene[wanted]) > 0)
    paths = np.concatenate([windows.observed, windows.future], axis=1)[wanted]  # (n, 20, 2)
    ahead = (paths - paths[:, 12:13])[:, 11::-1]
    np.testing.assert_allclose(
        (back.future - back.observed[:, -1:])[back.known], ahead[there[wanted][:, 11::-1]], atol=1e-5
    )
    late = ~back.seen[:, 0]
    first = back.seen.argmax(axis=1)
    np.testing.assert_array_equal(back.observed[late, 0], back.observed[late, first[late]])
    np.testing.assert_allclose(back.velocity, weighted_velocity(back.observed.astype(float), 0.4, back.seen), atol=1e-4)
    assert len(reversed_in_time(windows.select(~wanted))) == 0


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
    assert len(reversed_in_time(clip_windows(make_clip(frames=10), SPEC))) == 0
    assert len(clip_windows(Clip("dut/empty", 24.0, (), ()), SPEC)) == 0


def test_concatenated_scenes_are_numbered_on(make_clip):
    one, two = clip_windows(make_clip(seed=1), SPEC), clip_windows(make_clip(seed=2), SPEC)
    both = concatenate([one, clip_windows(make_clip(frames=5), SPEC), two])
    assert len(both) == len(one) + len(two)
    assert len(np.unique(both.scene)) == len(np.unique(one.scene)) + len(np.unique(two.scene))
    assert (np.diff(both.scene) >= 0).all()


def test_windows_that_differ_are_not_put_together(make_windows):
    with pytest.raises(ValueError, match=r"\(8, 12, 0\.1\), \(8, 12, 0\.4\)"):
        concatenate([make_windows(), make_windows(dt_s=0.1)])
    with pytest.raises(ValueError, match="no windows"):
        concatenate([])


def test_held_out_clips_are_refused():
    dataset.refuse_held_out(("dut/roundabout_02",))
    with pytest.raises(ValueError, match="citr/p2p_uni/walk_01, dut/intersection_08"):
        dataset.refuse_held_out(("dut/intersection_08", "citr/p2p_uni/walk_01"))


def test_split_of_the_public_clips_does_not_overlap(public_data):
    training = dataset.training_clip_names(public_data)
    assert len(training) == 27 - len(dataset.HELD_OUT_CLIPS) - len(dataset.VALIDATION_CLIPS)
    assert not set(training) & (set(dataset.HELD_OUT_CLIPS) | set(dataset.VALIDATION_CLIPS))
    dataset.refuse_held_out(training + dataset.VALIDATION_CLIPS)
