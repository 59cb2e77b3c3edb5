"""Batches hold every scene once; what is varied keeps the scene's geometry."""

import numpy as np
import pytest
import torch

from pcgan.batches import augment, batches
from pcgan.dataset import WindowSpec, clip_windows, concatenate

SPEC = WindowSpec(8, 12, 0.1, 0.2)


@pytest.fixture
def windows(make_clip):
    return concatenate([clip_windows(make_clip(pedestrians=n, vehicles=n % 2, seed=n), SPEC) for n in (1, 3, 9)])


@pytest.mark.parametrize("shuffled", [False, True])
def test_every_pedestrian_is_in_one_batch(windows, shuffled):
    generator = torch.Generator().manual_seed(1) if shuffled else None
    found = list(batches(windows, 40, generator))
    assert len(found) > 3
    real = [torch.diagonal(batch.neighbours, dim1=1, dim2=2) for batch in found]
    assert sum(int(r.sum()) for r in real) == len(windows)
    rows = torch.cat([batch.observed[r].flatten(1) for batch, r in zip(found, real, strict=True)]).numpy()
    expected = windows.observed.reshape(len(windows), -1)
    np.testing.assert_array_equal(rows[np.lexsort(rows.T)], expected[np.lexsort(expected.T)])
    assert all(batch.observed.shape[0] * batch.observed.shape[1] <= 40 for batch in found)


def test_batches_of_equal_seed_are_equal(windows):
    first = list(batches(windows, 64, torch.Generator().manual_seed(3)))
    again = list(batches(windows, 64, torch.Generator().manual_seed(3)))
    other = list(batches(windows, 64, torch.Generator().manual_seed(4)))
    assert all(torch.equal(a.observed, b.observed) for a, b in zip(first, again, strict=True))
    assert any(a.observed.shape != b.observed.shape or not torch.equal(a.observed, b.observed)
               for a, b in zip(first, other, strict=False))  # fmt: skip


def test_scene_larger_than_a_batch_is_a_batch(windows):
    assert max(batch.observed.shape[1] for batch in batches(windows, 2)) == 9


def test_augmented_scene_is_congruent(windows):
    batch = next(iter(batches(windows, 100)))
    varied = augment(batch, 0.0, 0.1, torch.Generator().manual_seed(0))

    def distances(b):
        path = torch.cat([b.observed, b.future, b.vehicle[..., :2].nan_to_num()], dim=2).flatten(1, 2)  # (S, points, 2)
        return torch.cdist(path, path)

    torch.testing.assert_close(distances(varied), distances(batch), atol=2e-2, rtol=1e-3)
    torch.testing.assert_close(varied.velocity.norm(dim=-1), batch.velocity.norm(dim=-1))
    step = varied.observed[:, :, -1] - varied.observed[:, :, -2]
    cosine = torch.nn.functional.cosine_similarity(step, varied.velocity, dim=-1)
    assert cosine.min() > 0.9  # velocities turned along
    assert not torch.allclose(varied.observed, batch.observed)


def test_noise_goes_to_annotated_scenes_only(make_clip):
    clip = make_clip()
    annotated = clip_windows(clip, SPEC)
    filtered = clip_windows(clip, SPEC, 0.05, np.random.default_rng(0))
    for windows, noisy in ((annotated, True), (filtered, False)):
        (batch,) = batches(windows, 10_000)
        plain = augment(batch, 0.0, 0.1, torch.Generator().manual_seed(0))
        varied = augment(batch, 0.1, 0.1, torch.Generator().manual_seed(0))
        moved = (varied.observed - plain.observed).abs().amax(dim=(1, 2, 3)) > 1e-6  # (S,)
        assert bool(moved.any()) is noisy
        assert not moved.all()
        torch.testing.assert_close(varied.future, plain.future)
