"""Batches hold every scene once; what is varied keeps the scene's geometry, and never the future alone."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from pcgan import dataset
from pcgan.batches import Augmentation, augment, batches, begun, weighted_velocity
from pcgan.dataset import WindowSpec, clip_windows, concatenate

SPEC = WindowSpec(8, 12, 0.1, 0.2)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def windows(make_clip):
    return concatenate([clip_windows(make_clip(pedestrians=n, vehicles=n % 2, seed=n), SPEC) for n in (1, 3, 9)])


@pytest.fixture
def whole(make_windows):
    """All of some windows as one batch."""

    def make(sizes=(1, 4, 2, 4, 3), **changes):
        (batch,) = batches(make_windows(sizes, **changes), 100_000)
        return batch

    return make


# --- batches ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shuffled", [False, True])
def test_every_pedestrian_is_in_one_batch(windows, shuffled):
    found = list(batches(windows, 40, seeded(1) if shuffled else None))
    assert len(found) > 3
    rows = torch.cat([batch.row[batch.real] for batch in found])
    assert sorted(rows.tolist()) == list(range(len(windows)))
    assert all(batch.real.numel() <= 40 for batch in found)
    for batch in found:
        scenes = windows.scene[batch.row.numpy()]  # (S, A)
        assert (scenes == scenes[:, :1]).all()  # padding repeats the scene's own


def test_row_maps_back_to_the_windows(make_windows):
    windows = make_windows((1, 3, 2, 5), gaps=True)
    for batch in batches(windows, 8):
        real, rows = batch.real, batch.row[batch.real].numpy()
        seen = batch.observation
        np.testing.assert_array_equal(seen.observed[real], windows.observed[rows])
        np.testing.assert_array_equal(seen.seen[real], windows.seen[rows])
        np.testing.assert_array_equal(seen.velocity[real], windows.velocity[rows])
        np.testing.assert_array_equal(seen.vehicle[real], windows.vehicle[rows])
        np.testing.assert_array_equal(batch.known[real], windows.known[rows])
        np.testing.assert_array_equal(batch.future[real], np.nan_to_num(windows.future[rows]))
        np.testing.assert_array_equal(batch.known_throughout[real], windows.known[rows].all(axis=1))


def test_padding_is_nobody(make_windows):
    (batch,) = batches(make_windows((1, 4, 3), gaps=True), 1000)
    assert batch.real.sum(dim=1).tolist() == [1, 3, 4]
    neighbours = batch.observation.neighbours
    np.testing.assert_array_equal(neighbours, batch.real[:, :, None] & batch.real[:, None, :])
    padding = ~batch.real
    assert not batch.known[padding].any()
    assert not batch.annotated[padding].any()
    assert batch.annotated[batch.real].all()
    assert all(torch.isfinite(part).all() for part in (batch.observation.observed, batch.future))


def test_batches_of_equal_seed_are_equal(windows):
    first, again, other = ([batch.row.tolist() for batch in batches(windows, 64, seeded(n))] for n in (3, 3, 4))
    assert first == again
    assert first != other


def test_without_a_generator_scenes_come_in_order_of_size(windows):
    sizes = [size for batch in batches(windows, 30) for size in batch.real.sum(dim=1).tolist()]
    assert sizes == sorted(sizes)
    assert len(sizes) == windows.scene[-1] + 1


def test_scene_larger_than_a_batch_is_a_batch(windows):
    assert max(batch.real.shape[1] for batch in batches(windows, 2)) == 9


def test_scenes_are_drawn_with_their_share(make_windows):
    windows = make_windows((1,) * 8000)
    share = np.repeat([0.3, 0.9, 0.0, 1.0], 2000)
    drawn = torch.cat([batch.row[batch.real] for batch in batches(windows, 500, seeded(2), share)]).numpy()
    assert len(np.unique(drawn)) == len(drawn)
    counts = np.bincount(drawn // 2000, minlength=4)
    assert abs(counts[0] - 600) < 5 * (2000 * 0.3 * 0.7) ** 0.5  # five deviations
    assert abs(counts[1] - 1800) < 5 * (2000 * 0.9 * 0.1) ** 0.5
    assert counts[2:].tolist() == [0, 2000]
    later = torch.cat([batch.row[batch.real] for batch in batches(windows, 500, seeded(3), share)]).numpy()
    assert set(later.tolist()) != set(drawn.tolist())


def test_shares_do_not_count_without_a_generator(make_windows):
    windows = make_windows((2, 3))
    assert sum(int(batch.real.sum()) for batch in batches(windows, 10, share=np.zeros(2))) == 5
    assert list(batches(windows, 10, seeded(), np.zeros(2))) == []


def test_no_windows_no_batches(make_windows):
    assert list(batches(make_windows(()), 10)) == []


# --- what is varied --------------------------------------------------------------------------------------------------


def distances(batch):
    """(S, n) between all of a scene's points: observed, future, vehicle."""
    vehicle = batch.observation.vehicle[..., :2]
    path = torch.cat([batch.observation.observed, batch.future, vehicle], dim=2).flatten(1, 2)  # (S, points, 2)
    return torch.cdist(path.double(), path.double()).flatten(1)


def turning(paths):
    """(S, A, T, 2) -> (S, A, T-2): twice the area between two displacements, positive to the left."""
    steps = paths.diff(dim=-2).double()
    return steps[..., :-1, 0] * steps[..., 1:, 1] - steps[..., :-1, 1] * steps[..., 1:, 0]


def test_augmented_scene_is_congruent(whole):
    batch = whole()
    varied = augment(batch, Augmentation(), 0.4, seeded())
    torch.testing.assert_close(distances(varied), distances(batch), atol=1e-3, rtol=1e-4)
    torch.testing.assert_close(varied.observation.velocity.norm(dim=-1), batch.observation.velocity.norm(dim=-1))
    assert ((varied.observation.observed - batch.observation.observed).abs().amax(dim=(1, 2, 3)) > 0.01).all()
    assert torch.equal(varied.known, batch.known)
    assert torch.equal(varied.row, batch.row)
    assert torch.equal(varied.real, batch.real)


def test_velocities_are_turned_along(whole):
    batch = whole(sizes=(3,) * 50)
    varied = augment(batch, Augmentation(), 0.4, seeded()).observation
    expected = weighted_velocity(varied.observed, varied.seen, 0.4)
    torch.testing.assert_close(varied.velocity, expected, atol=1e-4, rtol=1e-4)
    before, after = batch.observation.vehicle, varied.vehicle
    angle = torch.atan2(before[..., 1], before[..., 0]) - torch.atan2(before[..., 3], before[..., 2])
    turned = torch.atan2(after[..., 1], after[..., 0]) - torch.atan2(after[..., 3], after[..., 2])
    torch.testing.assert_close(turned.cos(), angle.cos(), atol=1e-3, rtol=0)


def test_half_of_the_scenes_are_mirrored(whole):
    batch = whole(sizes=(2,) * 400)
    varied = augment(batch, Augmentation(), 0.4, seeded())
    before, after = turning(batch.future), turning(varied.future)
    side = (after.flatten(1) * before.flatten(1)).sum(dim=1).sign()  # (S,)
    torch.testing.assert_close(after, side[:, None, None] * before, atol=1e-4, rtol=1e-3)
    assert abs(int((side < 0).sum()) - 200) < 50


def test_stretching_keeps_the_ratios_of_distances(whole):
    batch = whole(sizes=(2,) * 300)
    varied = augment(batch, Augmentation(scale=0.3), 0.4, seeded())
    ratio = distances(varied).sum(dim=1) / distances(batch).sum(dim=1)  # (S,)
    torch.testing.assert_close(distances(varied), distances(batch) * ratio[:, None], atol=1e-3, rtol=1e-4)
    assert 0.69999 < ratio.min() < 0.72
    assert 1.28 < ratio.max() < 1.30001
    speed, before = varied.observation.velocity.norm(dim=-1), batch.observation.velocity.norm(dim=-1)
    torch.testing.assert_close(speed, before * ratio[:, None].float(), atol=1e-4, rtol=1e-3)


def test_noise_goes_to_annotated_pedestrians_only(make_windows):
    windows = make_windows((3,) * 200)
    annotated = np.arange(600) % 3 > 0  # two of three in each scene
    (batch,) = batches(replace(windows, annotated=annotated), 10_000)
    plain = augment(batch, Augmentation(), 0.4, seeded())
    varied = augment(batch, Augmentation(noise_m=0.1), 0.4, seeded())
    moved = varied.observation.observed - plain.observation.observed  # (S, A, T, 2)
    assert not moved[~batch.annotated].any()
    assert torch.equal(varied.observation.velocity[~batch.annotated], plain.observation.velocity[~batch.annotated])
    assert torch.equal(varied.future, plain.future)
    assert torch.equal(varied.observation.vehicle, plain.observation.vehicle)
    noisy = moved.abs().amax(dim=(1, 2, 3)) > 0
    assert abs(int(noisy.sum()) - 100) < 36  # half of the scenes, within five deviations
    assert (moved[noisy][batch.annotated[noisy]].abs().amax(dim=(1, 2)) > 0).all()
    sigma = moved[noisy][batch.annotated[noisy]].unflatten(0, (-1, 2)).std(dim=(1, 2, 3))  # one for each scene
    assert 0.085 < sigma.max() < 0.13
    assert sigma.min() < 0.02
    expected = weighted_velocity(varied.observation.observed, varied.observation.seen, 0.4)
    torch.testing.assert_close(varied.observation.velocity[batch.annotated], expected[batch.annotated])


def seen_masks(T=8):
    earlier = st.lists(st.booleans(), min_size=T - 1, max_size=T - 1).filter(any)
    return earlier.map(lambda mask: [*mask, True])


@given(st.lists(seen_masks(), min_size=1, max_size=5), st.integers(0, 99), st.booleans())
def test_who_is_forgotten_keeps_two_steps_and_the_last_one(masks, seed, noisy):
    """No step is seen that was not, those kept stay where they are, those before the first repeat it."""
    N, seen = len(masks), np.array(masks)
    walks = np.random.default_rng(seed).normal(size=(N, 20, 2))
    observed = dataset.filled_in(walks[:, :8], seen)
    windows = dataset.centred(
        observed=observed,
        seen=seen,
        velocity=dataset.weighted_velocity(observed, 0.4, seen),
        future=walks[:, 8:],
        vehicle=np.full((N, 8, 4), np.nan),
        scene=np.zeros(N, np.int64),
        annotated=np.ones(N, bool),
        dt_s=0.4,
    )
    (batch,) = batches(windows, 100)
    plain = augment(batch, Augmentation(noise_m=0.1 * noisy), 0.4, seeded(seed)).observation
    varied = augment(batch, Augmentation(noise_m=0.1 * noisy, forget=1.0), 0.4, seeded(seed)).observation
    assert varied.seen[..., -1].all()
    assert (varied.seen.sum(dim=-1) >= 2).all()
    assert not (varied.seen & ~plain.seen).any()
    assert torch.equal(varied.observed[varied.seen], plain.observed[varied.seen])
    first = varied.seen.int().argmax(dim=-1)  # (1, N)
    at_first = varied.observed.gather(2, first[..., None, None].expand(-1, -1, 1, 2)).expand_as(varied.observed)
    before = torch.arange(8) < first[..., None]
    assert torch.equal(varied.observed[before], at_first[before])
    torch.testing.assert_close(varied.velocity, weighted_velocity(varied.observed, varied.seen, 0.4))


def test_a_share_forgets_any_number_of_steps(whole):
    """3,000 people seen throughout: 40 % may lose 0 to 6 steps, with equal chances."""
    batch = whole(sizes=(3,) * 1000)
    varied = augment(batch, Augmentation(forget=0.4), 0.4, seeded())
    lost = np.bincount((~varied.observation.seen).sum(dim=-1).flatten().numpy(), minlength=8)
    assert lost[7] == 0
    assert (np.abs(lost[1:7] - 3000 * 0.4 / 7) < 5 * (3000 * 0.4 / 7) ** 0.5).all()
    assert torch.equal(varied.future, augment(batch, Augmentation(), 0.4, seeded()).future)


def test_a_share_of_scenes_loses_its_vehicle(whole):
    batch = whole(sizes=(2,) * 500)
    vehicle = augment(batch, Augmentation(hide_vehicle=0.3), 0.4, seeded()).observation.vehicle
    hidden = vehicle.isnan()
    assert torch.equal(hidden.all(dim=(1, 2, 3)), hidden.any(dim=(1, 2, 3)))
    assert abs(int(hidden[:, 0, 0, 0].sum()) - 150) < 52
    without = replace(batch, observation=replace(batch.observation, vehicle=None))
    assert augment(without, Augmentation(hide_vehicle=1.0), 0.4, seeded()).observation.vehicle is None


def test_padding_stays_padding(whole):
    batch = whole(sizes=(1, 5, 2), gaps=True)
    how = Augmentation(noise_m=0.1, scale=0.2, forget=0.5, hide_vehicle=0.5)
    varied = augment(batch, how, 0.4, seeded())
    assert torch.equal(varied.observation.neighbours, batch.observation.neighbours)
    assert not varied.known[~batch.real].any()
    assert not varied.annotated[~batch.real].any()


def test_variation_is_repeatable(whole):
    how = Augmentation(noise_m=0.1, scale=0.2, forget=0.5)
    one, two, other = (augment(whole(), how, 0.4, seeded(n)).observation.observed for n in (5, 5, 6))
    assert torch.equal(one, two)
    assert not torch.equal(one, other)


def test_weighted_velocity_is_that_of_the_windows(make_windows):
    windows = make_windows((4, 6), gaps=True)
    found = weighted_velocity(torch.from_numpy(windows.observed), torch.from_numpy(windows.seen), 0.4)
    expected = dataset.weighted_velocity(windows.observed.astype(float), 0.4, windows.seen)
    np.testing.assert_allclose(found, expected, atol=1e-4)


def test_displacements_begin_at_the_first_seen_step():
    seen = torch.tensor([[True, False, True, True], [False, False, True, True], [False, True, False, True]])
    assert begun(seen).tolist() == [[1, 1, 1], [0, 0, 1], [0, 1, 1]]
