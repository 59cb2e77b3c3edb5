"""Scores of walks whose errors are known by hand."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from pcgan.dataset import Windows, WindowSpec, clip_windows
from pcgan.forecast import Extrapolation, Forecast, certain_path, mixture_of_samples
from pcgan.modal_paths import ModalPaths
from pcgan.protocols import eth_ucy_fold
from pcgan.scores import KDE_SAMPLES, measure, near_vehicle, quick_scores, scorable, score_method

DT_S = 0.4


@pytest.fixture
def generator():
    return torch.Generator().manual_seed(0)


def walks(N=4, *, apart_m=5.0, sideways_m=0.0, together=True):
    """N people walk along x at 1 m/s, one scene or one each; after the last observed step they are off to the side."""
    steps = np.arange(-7, 13)
    walk = np.stack([DT_S * steps, np.where(steps > 0, sideways_m, 0.0)], -1)
    walk = walk + np.stack([np.zeros(N), apart_m * np.arange(N)], -1)[:, None]
    walk = walk.astype(np.float32)
    return Windows(
        observed=walk[:, :8],
        seen=np.ones((N, 8), bool),
        velocity=np.tile(np.float32([1, 0]), (N, 1)),
        future=walk[:, 8:],
        vehicle=np.full((N, 8, 4), np.nan, np.float32),
        scene=np.zeros(N, np.int64) if together else np.arange(N),
        annotated=np.ones(N, bool),
        dt_s=DT_S,
    )


def cvm(sigma_m=0.5):
    return Extrapolation("cvm", 12, DT_S, torch.full((12,), sigma_m))


class Scatter:
    """Straight on, and N samples off to the side by 0, 1, 2 ... m."""

    def __init__(self, count):
        self.name, self.count = "scatter", count

    def forecast(self, observation, generator):  # noqa: ARG002
        path = cvm().path(observation)
        side = torch.arange(self.count, dtype=torch.float32)[:, None, None] * torch.tensor([0.0, 1.0])
        samples = path.unsqueeze(-3) + side
        probabilities = torch.full(samples.shape[:-2], 1 / self.count)
        return Forecast(mixture_of_samples(samples, torch.ones(12)), ModalPaths(probabilities, samples), samples)


class TwoWays:
    """Straight on with probability 0.6, else 1 m to the left; a third path has probability 0."""

    name = "two ways"

    def forecast(self, observation, generator):  # noqa: ARG002
        path = cvm().path(observation)
        points = torch.stack([path, path + torch.tensor([0.0, 1.0]), path], dim=-3)
        probabilities = torch.tensor([0.6, 0.4, 0.0]).expand(points.shape[:-2])
        return replace(certain_path(path, torch.ones(12)), paths=ModalPaths(probabilities, points))


def test_a_path_one_metre_off_everywhere(generator):
    scores = score_method(cvm(), walks(sideways_m=1.0), 12, generator)
    assert scores.pedestrians == 4
    assert (scores.ade, scores.fde, scores.mhd) == (pytest.approx(1), pytest.approx(1), pytest.approx(1))
    assert (scores.min_ade, scores.min_fde, scores.modal_paths) == (pytest.approx(1), pytest.approx(1), 1)
    assert scores.nll == pytest.approx(np.log(2 * np.pi * 0.25) + 0.5 * (1 / 0.5) ** 2, rel=1e-5)
    assert (scores.miss_rate, scores.collision_rate) == (0, 0)
    assert scores.as_dict()["ade"] == scores.ade


def test_misses_are_more_than_two_metres_off(generator):
    windows = walks(sideways_m=1.9)
    windows.future[0, :, 1] += 0.2
    assert score_method(cvm(), windows, 12, generator).miss_rate == 0.25


def test_both_horizons_and_a_subset_from_one_pass(generator):
    windows = walks(sideways_m=1.0, together=False)
    windows.future[0, 9:] = np.nan  # known for 9 steps: scored at 8
    windows.future[1, 0] = np.nan  # never
    windows.seen[2, 3] = False  # incomplete history: never
    measured = measure(cvm(), windows, (8, 12), generator)
    assert measured.rows.tolist() == [0, 3]
    assert measured.scores(8).pedestrians == 2
    assert measured.scores(12).pedestrians == 1
    assert measured.scores(8, np.array([True, False, False, False])).pedestrians == 1
    assert list(measured.figures()) == ["8", "12"]
    assert measured.figures()["12"]["fde"] == pytest.approx(1)
    with pytest.raises(ValueError, match="nobody"):
        measured.scores(12, np.array([True, False, False, False]))
    with pytest.raises(ValueError, match=r"horizons \[8, 12\], not 10"):
        measured.scores(10)


def test_those_who_are_not_scored_are_neighbours(generator):
    """The method sees them, and one can collide with them."""
    seen = []

    class Counts(Extrapolation):
        def forecast(self, observation, generator):
            seen.append(observation.observed.shape[-3])
            return super().forecast(observation, generator)

    windows = walks(2, apart_m=0.1)
    windows.seen[1, 0] = False
    scores = score_method(Counts("cvm", 12, DT_S), windows, 12, generator)
    assert seen == [2]
    assert scores.pedestrians == 1
    assert scores.collision_rate == scores.true_collision_rate == 1


def test_collisions_of_predictions_and_of_the_truth(generator):
    """0.1 m apart at first; two of three really step aside at once, so only the prediction collides."""
    windows = walks(3, apart_m=0.1)
    windows.future[:, :, 1] += np.float32([0, 3, 6])[:, None]
    scores = score_method(cvm(), windows, 12, generator)
    assert (scores.collision_rate, scores.true_collision_rate) == (1, 0)
    windows.future[1:] = np.nan  # those who have left collide with nobody
    assert score_method(cvm(), windows, 12, generator).collision_rate == 0


def test_of_samples_the_first_ten_are_averaged_and_twenty_may_be_best(generator):
    """Samples are 0 to 24 m off; the truth is where the 16th is."""
    windows = walks(sideways_m=15.0, apart_m=100)
    scores = score_method(Scatter(25), windows, 12, generator)
    assert scores.ade == pytest.approx(np.mean(15 - np.arange(10)), rel=1e-5)
    assert scores.mhd == pytest.approx(scores.ade, rel=0.05)  # nearest points are elsewhere on the way
    assert scores.min_ade_20 == pytest.approx(0, abs=1e-5)
    late = score_method(Scatter(25), walks(sideways_m=22.0, apart_m=100), 12, generator)
    assert late.min_fde_20 == pytest.approx(3, rel=1e-5)
    assert quick_scores(Scatter(25), windows).ade == pytest.approx(scores.ade, rel=1e-5)


def test_of_modal_paths_the_nearest_counts(generator):
    scores = score_method(TwoWays(), walks(sideways_m=1.0), 12, generator)
    assert (scores.ade, scores.min_ade, scores.min_fde) == (1, pytest.approx(0, abs=1e-6), pytest.approx(0, abs=1e-6))
    assert scores.modal_paths == 2


def test_the_nearest_of_samples_from_a_mixture_comes_near(generator):
    scores = score_method(cvm(1.0), walks(400, sideways_m=1.0, together=False), 12, generator)
    assert 0.1 < scores.min_ade_20 < 0.45  # 20 normal draws, 1 sigma away


def test_a_calibrated_method_is_found_so(generator):
    """Truths that scatter as the method says: coverage as asked, the area a Gaussian's, the likelihood its entropy."""
    windows = walks(1500, together=False)
    noise = torch.randn(1500, 12, 2, generator=generator).numpy() * 0.5
    windows = replace(windows, future=windows.future + noise.astype(np.float32))
    measured = measure(cvm(0.5), windows, (12,), generator)
    scores = measured.scores(12)
    assert scores.coverage_50 == pytest.approx(0.5, abs=0.02)
    assert scores.coverage_90 == pytest.approx(0.9, abs=0.01)
    assert scores.coverage_95 == pytest.approx(0.95, abs=0.01)
    assert scores.area_90_m2 == pytest.approx(2 * np.pi * 0.25 * np.log(10), rel=0.05)
    entropy = np.log(2 * np.pi * np.e * 0.25)
    assert scores.nll == pytest.approx(entropy, abs=0.03)
    assert scores.nll < scores.kde_nll < scores.nll + 0.15
    curves = measured.curves()
    np.testing.assert_allclose(curves.coverage, curves.shares, atol=0.02)
    np.testing.assert_allclose(curves.times_s, DT_S * np.arange(1, 13))
    np.testing.assert_allclose(curves.error_m, 0.5 * np.sqrt(np.pi / 2), rtol=0.06)
    assert scores.nll == pytest.approx(curves.nll.mean(), abs=1e-5)
    too_sure = measure(cvm(0.3), windows, (12,), generator).scores(12)
    assert too_sure.coverage_90 < 0.7


def test_equal_generators_give_equal_scores():
    windows = walks(30, sideways_m=0.3, together=False)
    first, again, other = (score_method(cvm(), windows, 12, torch.Generator().manual_seed(seed)) for seed in (1, 1, 2))
    assert first == again
    assert first.kde_nll != other.kde_nll
    assert KDE_SAMPLES > 20


def test_batch_size_does_not_matter(make_generator, make_clip):
    windows = clip_windows(make_clip(), WindowSpec(8, 12, 0.1))

    class Network:
        name = "network"

        def __init__(self):
            self.generator = make_generator()

        def forecast(self, observation, generator):  # noqa: ARG002
            mixture = self.generator(observation)
            return Forecast(
                mixture, ModalPaths(torch.ones(*mixture.rhos.shape[:-2], 1), mixture.means[..., 0, :].unsqueeze(-3))
            )

    small = measure(Network(), windows, (12,), torch.Generator().manual_seed(0), pedestrians=8).scores(12)
    large = measure(Network(), windows, (12,), torch.Generator().manual_seed(0), pedestrians=900).scores(12)
    quick = quick_scores(Network(), windows)
    assert small.pedestrians == large.pedestrians == quick.pedestrians == scorable(windows, 12).sum()
    for name in ("ade", "fde", "mhd", "nll", "collision_rate"):
        assert getattr(small, name) == pytest.approx(getattr(large, name), rel=1e-4), name
    for name in ("ade", "fde", "mhd", "nll", "modal_paths"):
        assert getattr(quick, name) == pytest.approx(getattr(large, name), rel=1e-4), name


def test_quick_scores_of_chosen_rows():
    windows = walks(sideways_m=1.0)
    windows.seen[:2, 0] = False
    windows.future[3, -1] = np.nan
    assert quick_scores(cvm(), windows).pedestrians == 1
    assert quick_scores(cvm(), windows, among=np.ones(4, bool)).pedestrians == 3
    with pytest.raises(ValueError, match="nobody to score"):
        quick_scores(cvm(), windows, among=np.zeros(4, bool))


def test_near_a_vehicle():
    windows = walks(3, apart_m=0.0)
    windows.vehicle[0] = [2.0, 4.0, 0, 0]  # 4.5 m from the walker's last observed position, and farther before
    windows.vehicle[1] = [0.0, 6.0, 0, 0]
    assert near_vehicle(windows).tolist() == [True, False, False]


def test_nobody_to_score_is_an_error(generator):
    windows = walks()
    unknown = replace(windows, future=windows.future * np.nan)
    with pytest.raises(ValueError, match="future known for 8 steps"):
        measure(cvm(), unknown, (8, 12), generator)
    with pytest.raises(ValueError, match="horizons must be 1 to 12 steps, got"):
        measure(cvm(), windows, (8, 20), generator)
    with pytest.raises(ValueError, match="future known for 8 steps"):
        measure(cvm(), windows.select(np.zeros(4, bool)), (8,), generator)


def test_weighted_velocity_on_hotel_is_as_measured_before(public_data, generator):
    """DESIGN section 7, by the window rule that gives 1197 trajectories; and those known for 8 steps."""
    windows = eth_ucy_fold("hotel", data_dir=public_data).test
    measured = measure(Extrapolation("weighted", 12, DT_S), windows, (8, 12), generator)
    scores = measured.scores(12)
    assert (scores.pedestrians, round(scores.ade, 2), round(scores.fde, 2)) == (1197, 0.25, 0.48)
    assert measured.scores(8).pedestrians > 1197
