"""The corridor against closed forms, and against a large Monte Carlo that knows nothing of pieces."""

from dataclasses import replace
from statistics import NormalDist

import numpy as np
import pytest

from pcgan.corridor import MARGIN_M, Futures, corridor_of, entries, footprints
from pcgan.vehicle_path import FRONT_M, REAR_M, WIDTH_M, Motion, brake, drive_on, swerve
from schemas.messages import VehiclePath

DT_S, STEPS = 0.4, 12
TIMES_S = DT_S * np.arange(STEPS + 1)
EDGE_M = WIDTH_M / 2 + MARGIN_M  # of a straight corridor, from its middle


def path_of(poses, times_s=TIMES_S, front_m=FRONT_M, rear_m=REAR_M, width_m=WIDTH_M):
    return VehiclePath(np.array(times_s, float), np.array(poses, float).reshape(-1, 3), front_m, rear_m, width_m)


def straight(speed_mps=2.0):
    return drive_on(Motion(0, 0, 0, speed_mps, 0), TIMES_S)


def walkers(*walks, sigma_m=1e-4):
    """Futures of one path each, from (x, y, vx, vy), as surely known as that."""
    states = np.array(walks, float)
    paths = states[:, None, :2] + TIMES_S[1:, None] * states[:, None, 2:]
    A, ones = len(states), np.ones((len(states), STEPS, 1), np.float32)
    return Futures(
        states[:, :2], np.tile(sigma_m**2 * np.eye(2), (A, 1, 1)), np.ones((A, 1)), paths[:, None], ones,
        paths[:, :, None], np.full((A, STEPS, 1, 2), sigma_m, np.float32), 0 * ones,
    )  # fmt: skip


def random_futures(rng, A=10, L=3, K=6):
    """Futures of several modes that part, components around each, and correlations."""
    starts = np.column_stack([rng.uniform(-3, 12, A), rng.uniform(-5, 5, A)])
    velocities = rng.normal(0, 0.8, (A, L, 1, 2))
    t = TIMES_S[1:, None]
    paths = starts[:, None, None] + t * velocities + 0.05 * rng.normal(0, 1, (A, L, 1, 2)) * t**2
    owner = np.arange(K) % L
    means = np.moveaxis(paths[:, owner], 1, 2) + 0.15 * t[:, None] * rng.normal(0, 1, (A, 1, K, 2))
    weights = np.broadcast_to(rng.dirichlet(np.full(K, 2.0), A)[:, None], (A, STEPS, K))
    probabilities = np.stack([weights[:, -1, owner == path].sum(axis=1) for path in range(L)], axis=1)
    if L > 1 < A:  # as the network's: a pedestrian with fewer paths repeats one with probability 0
        probabilities[0] = [1, *[0] * (L - 1)]
        paths[0] = paths[0, 0]
    sigmas = rng.uniform(0.05, 0.3, (A, 1, K, 2)) * (1 + t[:, None])
    spread = rng.normal(0, 0.1, (A, 2, 2))
    return Futures(
        starts, spread @ spread.swapaxes(1, 2) + 0.01 * np.eye(2), probabilities, paths, weights.astype(np.float32),
        means, sigmas.astype(np.float32), rng.uniform(-0.9, 0.9, (A, STEPS, K)).astype(np.float32),
    )  # fmt: skip


# --- closed forms ----------------------------------------------------------------------------------------------------


def test_who_crosses_ahead_enters_at_the_edge():
    walks = [(8, 2, 0, -1), (8, -2, 0, 0.5), (8, 2, 0, 1), (8, 0.5, 0, 1), (8, 0, 0, 0)]
    probability, time_s = entries(corridor_of(straight(), DT_S, STEPS), walkers(*walks))
    np.testing.assert_allclose(probability, [1, 1, 0, 1, 1])
    np.testing.assert_allclose(time_s, [2 - EDGE_M, (2 - EDGE_M) / 0.5, np.nan, 0, 0], atol=1e-3)


def test_the_corridor_ends_where_the_vehicle_is_at_the_horizon():
    end = FRONT_M + 2 * STEPS * DT_S + MARGIN_M
    probability, time_s = entries(
        corridor_of(straight(), DT_S, STEPS), walkers((end + 0.1, 0, 0, 0), (end - 0.1, 0, 0, 0), (end + 1, 0, -0.5, 0))
    )
    np.testing.assert_allclose(probability, [0, 1, 1])
    assert time_s[2] == pytest.approx(2, abs=1e-3)


def test_what_the_vehicle_has_left_behind_no_longer_counts():
    """At 2 m/s it has passed x = 4 m at 2.45 s, margin included: who comes later does not enter."""
    gone_s = (4 + REAR_M + MARGIN_M) / 2
    walks = [(4, EDGE_M + gone_s - 0.05, 0, -1), (4, EDGE_M + gone_s + 0.05, 0, -1), (-3, 0, 1.9, 0), (-1, 0, 1, 0)]
    probability, time_s = entries(corridor_of(straight(), DT_S, STEPS), walkers(*walks))
    np.testing.assert_allclose(probability, [1, 0, 0, 0])
    assert time_s[0] == pytest.approx(gone_s - 0.05, abs=1e-3)


def test_who_catches_up_with_a_braking_vehicle_enters():
    path = brake(Motion(0, 0, 0, 4, 0), TIMES_S, 4.0)  # stands at x = 2 m from 1 s on
    probability, time_s = entries(corridor_of(path, DT_S, STEPS), walkers((-2, 0, 1, 0), (5.5, 0, 0, 0)))
    np.testing.assert_allclose(probability, [1, 0])
    assert time_s[0] == pytest.approx(2 - REAR_M - MARGIN_M + 2, abs=0.01)


@pytest.mark.parametrize("distance_m", [-0.5, 0.0, 0.3, 0.8])
def test_probability_of_who_stands_beside_is_the_normal_distributions(distance_m):
    """Somebody stands so far from the edge, known to 0.5 m: inside now, or never."""
    futures = walkers((5, EDGE_M + distance_m, 0, 0), sigma_m=0.5)
    probability, time_s = entries(corridor_of(straight(), DT_S, STEPS), futures)
    assert probability[0] == pytest.approx(NormalDist().cdf(-distance_m / 0.5), abs=1 / 64)
    assert time_s[0] == pytest.approx(0, abs=1e-6)


def test_expected_time_is_over_those_who_enter():
    """Two paths of equal probability: one enters after 1 s, the other never does."""
    one, other = walkers((8, EDGE_M + 1, 0, -1)), walkers((8, EDGE_M + 1, 0, 1))
    both = replace(
        one,
        probabilities=np.array([[0.5, 0.5]]),
        paths_m=np.concatenate([one.paths_m, other.paths_m], axis=1),
        weights=np.full((1, STEPS, 2), 0.5, np.float32),
        means_m=np.concatenate([one.means_m, other.means_m], axis=2),
        sigmas_m=np.full((1, STEPS, 2, 2), 1e-4, np.float32),
        rhos=np.zeros((1, STEPS, 2), np.float32),
    )
    probability, time_s = entries(corridor_of(straight(), DT_S, STEPS), both)
    assert (probability[0], time_s[0]) == (pytest.approx(0.5), pytest.approx(1, abs=1e-3))


def test_a_corner_cut_within_one_step_is_seen():
    """From outside to outside between two predicted steps, across a corner of a standing vehicle."""
    corner_x, corner_y = FRONT_M + MARGIN_M, EDGE_M
    walk = (corner_x + 0.1, corner_y - 0.2, -1, 1)  # inside from 0.1 to 0.2 s; steps at 0 and 0.4 s are outside
    probability, time_s = entries(corridor_of(straight(0.0), DT_S, STEPS), walkers(walk))
    assert (probability[0], time_s[0]) == (1, pytest.approx(0.1, abs=1e-3))


def test_a_standing_vehicle_is_its_own_corridor():
    corridor = corridor_of(straight(0.0), DT_S, STEPS)
    assert len(corridor) == 1
    probability, _ = entries(corridor, walkers((FRONT_M + MARGIN_M + 0.01, 0, 0, 0), (0, 0, 0, 0), (9, 0, -3, 0)))
    np.testing.assert_allclose(probability, [0, 1, 1])


def test_reversing_leaves_what_is_ahead_behind():
    path = straight(-2.0)
    probability, _ = entries(corridor_of(path, DT_S, STEPS), walkers((4, 0, 0, 0), (-6, 0, 0, 0), (3, 0, -0.1, 0)))
    np.testing.assert_allclose(probability, [0, 1, 0])


@pytest.mark.parametrize("margin_m", [0.0, 0.3, 1.0])
def test_margin_widens_it_on_every_side(margin_m):
    low_x, high_x, side = -REAR_M - margin_m, FRONT_M + 9.6 + margin_m, WIDTH_M / 2 + margin_m
    for gap, inside in ((0.01, 1), (-0.01, 0)):
        walks = [(low_x + gap, 0, 0, 0), (high_x - gap, 0, 0, 0), (5, side - gap, 0, 0), (5, -side + gap, 0, 0)]
        probability, _ = entries(corridor_of(straight(), DT_S, STEPS, margin_m), walkers(*walks))
        np.testing.assert_allclose(probability, inside)
    outlines = footprints(straight(), 4.8, margin_m)
    np.testing.assert_allclose(outlines.min(axis=(0, 1)), [low_x, -side])
    np.testing.assert_allclose(outlines.max(axis=(0, 1)), [high_x, side])


def test_outlines_follow_a_turning_vehicle():
    path = path_of([(3, 4, np.pi - 0.1), (3, 4, -np.pi + 0.1)], [0, 4])  # over pi, not back through 0
    first, middle, last = footprints(path, 4.0, margin_m=0.0, count=3)
    np.testing.assert_allclose(middle, [(3.6, 4.7), (0.6, 4.7), (0.6, 3.3), (3.6, 3.3)])
    for outline, yaw in ((first, np.pi - 0.1), (last, -np.pi + 0.1)):
        nose = outline[1:3].mean(axis=0) - [3, 4]
        np.testing.assert_allclose(nose, FRONT_M * np.array([np.cos(yaw), np.sin(yaw)]))


def test_a_path_that_ends_early_leaves_the_vehicle_standing_there():
    path = path_of([(0, 0, 0), (4, 0, 0)], [0, 2])
    probability, time_s = entries(
        corridor_of(path, DT_S, STEPS),
        walkers((5, 4, 0, -1), (FRONT_M + 4 + MARGIN_M + 0.1, 0, 0, 0), (2, 4, 0, -1)),
    )
    np.testing.assert_allclose(probability, [1, 0, 0])
    assert time_s[0] == pytest.approx(4 - EDGE_M, abs=1e-3)


def test_a_path_beyond_the_horizon_is_cut_and_a_late_one_waited_for():
    long = path_of([(0, 0, 0), (200, 0, 0)], [0, 100])
    late = path_of([(0, 0, 0), (9.6, 0, 0)], [4.7, 9.5])  # stands until 4.7 s
    for path, reach_m in ((long, 9.6), (late, 0.2)):
        end = FRONT_M + MARGIN_M + reach_m
        futures = walkers((end - 0.01, 0, 0, 0), (end + 0.01, 0, 0, 0))
        np.testing.assert_allclose(entries(corridor_of(path, DT_S, STEPS), futures)[0], [1, 0])
        assert footprints(path, STEPS * DT_S)[..., 0].max() == pytest.approx(end)


# --- pieces ----------------------------------------------------------------------------------------------------------


def test_straight_drives_are_one_piece_whatever_the_speed_and_curves_are_several():
    assert len(corridor_of(straight(20.0), DT_S, STEPS)) == 1
    assert len(corridor_of(brake(Motion(3, 4, 2, 8, 0), TIMES_S, 3), DT_S, STEPS)) == 1
    gentle = corridor_of(drive_on(Motion(0, 0, 0, 5, 0.1), TIMES_S), DT_S, STEPS)
    sharp = corridor_of(drive_on(Motion(0, 0, 0, 5, 0.5), TIMES_S), DT_S, STEPS)
    assert 3 <= len(gentle) < len(sharp) <= 24
    assert len(corridor_of(path_of([(0, 0, 0), (2, 0, 0), (0, 0, 0)], [0, 1, 2]), DT_S, STEPS)) == 2
    sideways = path_of([(0, 0, 0), (0, 3, 0)], [0, 4])
    assert len(corridor_of(sideways, DT_S, STEPS)) >= 10


def covered_later(path, times_s, margin_m=MARGIN_M):
    """The vehicle's boxes at many times: x, y, cos, sin and the last of them, for a test by points."""
    yaw = np.interp(times_s, path.times_s, np.unwrap(path.poses[:, 2]))
    x, y = (np.interp(times_s, path.times_s, path.poses[:, i]) for i in range(2))

    def last_index(points):
        """(..., 2) -> the last of the times at which the footprint covers it, as an index; -1: never."""
        last = np.full(points.shape[:-1], -1)
        for i in range(len(times_s)):
            dx, dy = points[..., 0] - x[i], points[..., 1] - y[i]
            ahead, left = np.cos(yaw[i]) * dx + np.sin(yaw[i]) * dy, np.cos(yaw[i]) * dy - np.sin(yaw[i]) * dx
            lengthwise = (ahead >= -path.rear_m - margin_m) & (ahead <= path.front_m + margin_m)
            last[lengthwise & (np.abs(left) <= path.width_m / 2 + margin_m)] = i
        return last

    return last_index


def covariances_of(futures, i, path):
    """The covariance of one path at every step (P + 1, 2, 2), in plain loops."""
    found = [futures.covariances_m2[i]]
    real = np.flatnonzero(futures.probabilities[i] > 0)
    for step in range(STEPS):
        total, mass = np.zeros((2, 2)), 0.0
        for k, weight in enumerate(futures.weights[i, step]):
            sx, sy = futures.sigmas_m[i, step, k].astype(float)
            own = np.array([[sx**2, futures.rhos[i, step, k] * sx * sy], [futures.rhos[i, step, k] * sx * sy, sy**2]])
            off = futures.means_m[i, step, k] - futures.paths_m[i, :, step]
            nearness = np.exp(-(off**2).sum(axis=1) / np.trace(own))
            share = weight * nearness[path] / nearness[real].sum()
            total, mass = total + share * (own + np.outer(off[path], off[path])), mass + share
        found.append(total / mass)
    return np.array(found)


def monte_carlo(path, futures, rng, draws=400, fine=8):
    """Probability and time of every pedestrian: many draws, footprints 0.05 s apart, no pieces and no clipping."""
    times = np.linspace(0, TIMES_S[-1], STEPS * fine + 1)
    last_index = covered_later(path, times)
    figures = []
    for i in range(len(futures.places_m)):
        entered, when = 0.0, 0.0
        for number in np.flatnonzero(futures.probabilities[i] > 0):
            nodes = np.concatenate([futures.places_m[i, None], futures.paths_m[i, number]])
            values, vectors = np.linalg.eigh(covariances_of(futures, i, number))
            roots = (vectors * np.sqrt(values)[:, None]) @ vectors.swapaxes(1, 2)
            off = np.einsum("pij,nj->npi", roots, rng.normal(size=(draws, 2)))
            walked = nodes + off  # (draws, P + 1, 2)
            step, fraction = np.divmod(np.arange(len(times)), fine)
            after = np.minimum(step + 1, STEPS)
            points = walked[:, step] + (fraction / fine)[:, None] * (walked[:, after] - walked[:, step])
            inside = last_index(points) >= np.arange(len(times))
            first = times[inside.argmax(axis=1)][inside.any(axis=1)]
            entered += futures.probabilities[i, number] * inside.any(axis=1).mean()
            when += futures.probabilities[i, number] * first.sum() / draws
        figures.append((entered, when / entered if entered else np.nan))
    return np.array(figures).T


PATHS = {
    "straight": straight(2.0),
    "fast": straight(12.0),
    "curve": drive_on(Motion(0, 0, 0, 3, 0.25), TIMES_S),
    "sharp curve": drive_on(Motion(0, 0, 0, 3, -0.6), TIMES_S),
    "brake": brake(Motion(0, 0, 0, 4, 0.1), TIMES_S, 2.0),
    "swerve": swerve(Motion(0, 0, 0, 4, 0), TIMES_S, 1.5, 2.0),
    "reverse": drive_on(Motion(8, 0, 0, -2, 0.1), TIMES_S),
    "there and back": path_of([(0, 0, 0), (5, 0, 0), (5, 0, 0), (1, -0.5, 0.25)], [0, 2, 3, 4.8]),
    "sideways": path_of([(2, -2, 0), (6, 2, 0)], [0, 4.8]),
}


@pytest.mark.parametrize("name", PATHS)
@pytest.mark.parametrize("L", [1, 3])
def test_figures_are_those_of_a_large_monte_carlo(name, L):
    rng = np.random.default_rng(5)
    futures = random_futures(rng, L=L)
    probability, time_s = entries(corridor_of(PATHS[name], DT_S, STEPS), futures)
    wanted, wanted_s = monte_carlo(PATHS[name], futures, rng)
    assert 1 < wanted.sum() < len(wanted) - 1  # some enter, some do not
    assert np.abs(probability - wanted).max() < 0.1
    assert np.abs(probability - wanted).mean() < 0.02
    likely = wanted > 0.1
    late_s = np.abs(time_s - wanted_s)[likely]
    assert late_s.max() < 0.4  # a probability of 0.1 is six trajectories
    assert np.average(late_s, weights=wanted[likely]) < 0.1


# --- laws ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("angle", [0.7, 2.5, -1.6])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (334_000.0, 6_250_000.0)])
def test_turned_and_moved_scenes_have_the_same_figures(angle, shift):
    futures, path = random_futures(np.random.default_rng(2), A=30), PATHS["curve"]
    c, s = np.cos(angle), np.sin(angle)
    turn, shift = np.array([[c, -s], [s, c]]), np.array(shift)

    def moved(points):
        return points @ turn.T + shift

    sx, sy = np.moveaxis(futures.sigmas_m.astype(float), -1, 0)
    own = np.stack([np.stack([sx**2, futures.rhos * sx * sy], -1), np.stack([futures.rhos * sx * sy, sy**2], -1)], -1)
    turned = turn @ own @ turn.T
    sigmas = np.sqrt(np.diagonal(turned, axis1=-2, axis2=-1))
    elsewhere = replace(
        futures,
        places_m=moved(futures.places_m),
        covariances_m2=turn @ futures.covariances_m2 @ turn.T,
        paths_m=moved(futures.paths_m),
        means_m=moved(futures.means_m),
        sigmas_m=sigmas,
        rhos=turned[..., 0, 1] / sigmas.prod(axis=-1),
    )
    poses = np.column_stack([moved(path.poses[:, :2]), path.poses[:, 2] + angle])
    probability, time_s = entries(corridor_of(path, DT_S, STEPS), futures)
    found, found_s = entries(corridor_of(replace(path, poses=poses), DT_S, STEPS), elsewhere)
    np.testing.assert_allclose(found, probability, atol=1 / 64)  # one trajectory may end on an edge
    assert np.mean(np.abs(found - probability) > 1e-5) < 0.1
    np.testing.assert_allclose(found_s, time_s, atol=0.02)


def test_everybody_has_the_figures_they_have_alone():
    futures, corridor = random_futures(np.random.default_rng(3), A=30), corridor_of(PATHS["curve"], DT_S, STEPS)
    together = entries(corridor, futures)
    for i in range(30):
        alone = entries(corridor, Futures(**{name: array[i : i + 1] for name, array in vars(futures).items()}))
        np.testing.assert_array_equal(np.array(alone)[:, 0], np.array(together)[:, i])


def test_probabilities_and_times_are_in_range_and_repeat():
    for seed in range(5):
        futures = random_futures(np.random.default_rng(seed), A=60)
        corridor = corridor_of(PATHS["swerve"], DT_S, STEPS)
        probability, time_s = entries(corridor, futures)
        assert ((probability >= 0) & (probability <= 1)).all()
        np.testing.assert_array_equal(np.isnan(time_s), probability == 0)
        assert (time_s[probability > 0] >= 0).all()
        assert (time_s[probability > 0] <= STEPS * DT_S).all()
        np.testing.assert_array_equal(entries(corridor, futures), (probability, time_s))


def test_nobody_has_no_figures():
    probability, time_s = entries(corridor_of(straight(), DT_S, STEPS), random_futures(np.random.default_rng(0), A=0))
    assert probability.shape == time_s.shape == (0,)


def test_a_path_that_no_component_is_near_still_has_a_finite_spread():
    futures = walkers((8, 3, 0, -1))
    astray = replace(
        futures,
        probabilities=np.array([[0.6, 0.4]]),
        paths_m=np.concatenate([futures.paths_m, futures.paths_m + np.array([0, 500])], axis=1),
    )
    probability, time_s = entries(corridor_of(straight(), DT_S, STEPS), astray)
    assert 0.6 - 1e-6 <= probability[0] <= 1
    assert np.isfinite(time_s[0])
