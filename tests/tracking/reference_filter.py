"""One scan of the labelled GM-PHD recursion, one component at a time, on filterpy's Kalman filter.

Slow and plain on purpose: `tracking.tracker.advance` does the same with arrays, and has to agree. `step` is the whole
of it: predict, gate and weigh, own, unresolved, update, births, prune, merge, settle. It takes the settings and the
measurements of `tracking`, and none of its code.
"""

import copy
import math
from dataclasses import dataclass, field

import numpy as np
from filterpy.common import Q_discrete_white_noise
from filterpy.kalman import KalmanFilter
from scipy.optimize import linear_sum_assignment


@dataclass
class Component:
    """One weighted Gaussian of a label."""

    weight: float
    kalman: KalmanFilter  # x (4, 1), P (4, 4)
    in_view: float = 0.0  # detection probability where it is predicted


@dataclass
class Label:
    """One possible person, with everything the tracker remembers of it; its components are sorted, heaviest first."""

    born_ns: int
    born_index: int
    last_hit_ns: int
    existence: float
    class_log_odds: float
    measurement: int  # of the latest scan, or -1
    hits: int = 1
    confirmed: bool = False
    hidden: float = 0.0
    components: list[Component] = field(default_factory=list)

    @property
    def mass(self):
        return sum(component.weight for component in self.components)

    @property
    def pedestrian(self):
        return 1 / (1 + math.exp(-self.class_log_odds))


def step(labels, scan, stamp_ns, dt_s, detection_probability, params, *, clutter_per_m2, repeats=0):
    """The labels after one more scan.

    Args:
        labels: list of Label after the scan before; left as they are.
        scan: Measurements.
        stamp_ns: of the scan.
        dt_s: since the scan before.
        detection_probability: of a person at [x, y]; a function of one position.
        params: TrackerParams.
        clutter_per_m2: expected false measurements of this scan per square metre.
        repeats: how many scans before this one had its stamp.
    """
    settings, M = params.filter, len(scan)
    z, R, q = scan.positions_m, scan.covariances_m2, scan.pedestrian_probability
    swerves = [swerve(label, labels, params.filter) for label in labels]
    labels = [
        predicted(label, dt_s, acceleration, detection_probability, params)
        for label, acceleration in zip(labels, swerves, strict=True)
    ]

    # Gate, and weigh the pairs inside: detection, nearness, and whether class and cameras agree.
    pairs = {}  # (label, component, measurement) -> mass, Kalman filter after the measurement
    for i, label in enumerate(labels):
        for j, component in enumerate(label.components):
            for m in range(M):
                after = updated(component.kalman, z[m], R[m])
                distance = (after.y.T @ after.SI @ after.y).item()
                if distance < settings.gate:
                    density = math.exp(-distance / 2) / (2 * math.pi * math.sqrt(np.linalg.det(after.S)))
                    in_view = max(component.in_view, detection_probability(z[m]))
                    mass = in_view * (1 - label.hidden) * component.weight * density * agreement(label, q[m], settings)
                    pairs[i, j, m] = mass, after

    # A measurement is one label's, clutter or a birth (Vo & Ma's denominator).
    background = [clutter_per_m2 * (1 - q[m]) + 0.5 * settings.birth_per_m2 for m in range(M)]
    total = totals(pairs, background)
    births = [0.5 * settings.birth_per_m2 / total[m] for m in range(M)]

    # Own: one measurement per label, one label per measurement, the most mass in all.
    share = np.zeros((len(labels), M))
    for (i, _, m), (mass, _) in pairs.items():
        share[i, m] += mass / total[m]
    best = zip(*linear_sum_assignment(share, maximize=True), strict=True)
    owned = {int(i): int(m) for i, m in best if share[i, m] > 0}
    pairs = {(i, j, m): pair for (i, j, m), pair in pairs.items() if owned.get(i) == m}
    total = totals(pairs, background)

    # Unresolved: who owns nothing may be in another's measurement. Then update.
    detected = [
        [Component(mass / total[m], after) for (k, _, m), (mass, after) in pairs.items() if k == i]
        for i in range(len(labels))
    ]
    explains = [min(sum(component.weight for component in mine), 1 - 1e-12) for mine in detected]
    for i, (label, mine, explained) in enumerate(zip(labels, detected, explains, strict=True)):
        others = {} if i in owned else owned
        chances = [explains[k] * together(label.components[0].kalman, z[m], R[m], settings) for k, m in others.items()]
        unresolved = max(chances, default=0.0)
        seen = (1 - label.hidden) * (1 - unresolved)
        believe(label, unresolved, explained)
        label.measurement = owned[i] if explained > 0.5 else -1
        if label.measurement >= 0:
            count(label, q[label.measurement], stamp_ns, dt_s, params)
        enough = label.hits >= params.confirm_hits and label.existence > params.confirm_existence
        label.confirmed = label.confirmed or enough
        # Missed is a label as far as the measurement it owns is something else.
        label.components = [
            Component(c.weight * (1 - c.in_view * seen) * (1 - explained), c.kalman) for c in label.components
        ] + mine

    # Births, at what nobody accounts for.
    taken = {label.measurement for label in labels}
    for m in np.flatnonzero(scan.gives_birth).tolist():
        if m not in taken and births[m] >= settings.prune_weight and q[m] >= settings.least_pedestrian_probability:
            P = np.zeros((4, 4))
            P[:2, :2], P[2:, 2:] = R[m], settings.birth_speed_mps**2 * np.eye(2)
            born = Label(stamp_ns, m + repeats * 2**20, stamp_ns, births[m], math.log(q[m] / (1 - q[m])), m)
            born.components = [Component(births[m], gaussian([*z[m], 0, 0], P))]
            labels.append(born)

    # Prune and merge within each label, then set its mass to its existence: it is one person at most.
    living = []
    for label in labels:
        label.components = merged(pruned(label.components, settings), settings)
        least = params.drop_existence if label.confirmed else settings.prune_weight
        if label.components and label.existence >= least:
            mass = label.mass
            for component in label.components:
                component.weight *= label.existence / mass
            living.append(label)
    return living


def gaussian(mean, cov):
    """A Kalman filter in the state [x, y, vx, vy] that measures [x, y].

    filterpy broadcasts a wrong shape of x or z without a word, so the shapes are checked here and in `updated`; H is an
    attribute and never an argument of update, which would then not check z.
    """
    kalman = KalmanFilter(dim_x=4, dim_z=2)
    kalman.H = np.eye(2, 4)
    kalman.x = np.array(mean, float).reshape(4, 1)
    kalman.P = np.array(cov, float).reshape(4, 4)
    return kalman


def updated(kalman, z, R):
    """A copy that has taken in z; its y, SI and S are the innovation's."""
    assert z.shape == (2,)
    assert R.shape == (2, 2)
    assert np.isfinite(z).all()  # NaN would stay in the filter for good
    kalman = gaussian(kalman.x, kalman.P)
    kalman.update(z.reshape(2, 1), R=R)
    assert kalman.x.shape == (4, 1)
    return kalman


def swerve(label, labels, settings):
    """How a person accelerates to make way for those who come nearer: the sum over the others of a social force."""
    total = np.zeros(2)
    if label.components[0].weight <= 0.5:
        return total
    me = label.components[0].kalman.x[:, 0]
    for other in labels:
        it = other.components[0].kalman.x[:, 0]
        apart = me[:2] - it[:2]
        distance = math.hypot(*apart)
        if other is label or other.components[0].weight <= 0.5 or distance > 1.5:
            continue
        gap = max(distance, 0.1)
        closing = -((me[2:] - it[2:]) @ apart) / gap
        eager = min(max(closing / 0.5, 0.0), 1.0)
        total += settings.avoidance_mps2 * eager * math.exp((0.5 - gap) / settings.avoidance_reach_m) * apart / gap
    return total


def predicted(label, dt_s, acceleration, detection_probability, params):
    """A copy of the label dt_s later. What is out of view is forgotten sooner; what is confirmed may hide."""
    label = copy.copy(label)
    rate = params.hide_per_s + params.show_per_s
    if not label.confirmed:
        label.hidden = 0.0
    elif rate > 0:
        at_rest = params.hide_per_s / rate
        label.hidden = at_rest + (label.hidden - at_rest) * math.exp(-rate * dt_s)

    before = [Component(component.weight, component.kalman) for component in label.components]
    if math.hypot(*acceleration) > 0.3:  # two hypotheses of where the heaviest goes: on, or out of the way
        t, heaviest = min(dt_s, 0.2), before[0]
        moved = heaviest.kalman.x + np.concatenate([0.5 * t * t * acceleration, t * acceleration]).reshape(4, 1)
        before.append(Component(0.7 * heaviest.weight, gaussian(moved, heaviest.kalman.P)))
        heaviest.weight *= 0.3
        before.sort(key=lambda component: -component.weight)
    components = []
    for component in before:
        kalman = gaussian(component.kalman.x, component.kalman.P)
        kalman.F = np.eye(4) + dt_s * np.eye(4, k=2)
        variance = params.filter.acceleration_mps2**2  # filterpy wants it squared
        kalman.Q = Q_discrete_white_noise(2, dt_s, variance, block_size=2, order_by_dim=False)
        kalman.predict()
        in_view = detection_probability(kalman.x[:2, 0])
        stays = math.exp(-dt_s / (params.filter.survival_s if in_view > 0 else params.filter.survival_unseen_s))
        components.append(Component(component.weight * stays, kalman, in_view))
    label.components = components
    return label


def totals(pairs, background):
    """What may have caused each measurement: background and every pair."""
    return [level + sum(mass for (_, _, n), (mass, _) in pairs.items() if n == m) for m, level in enumerate(background)]


def agreement(label, q, settings):
    """The probability that the label and the cameras say the same; what is surely nobody is no pedestrian's."""
    if q < settings.least_pedestrian_probability and label.pedestrian > 0.5:
        return 0.0
    return label.pedestrian * q + (1 - label.pedestrian) * (1 - q)


def together(kalman, z, R, settings):
    """The probability that a person and another one's measurement are one cluster, 1/2 at a distance of resolution_m.

    It falls like a Gaussian with the distance (Koch & van Keuk 1997), averaged over where the two may be.
    """
    if settings.resolution_m == 0:
        return 0.0
    blur = settings.resolution_m**2 / (2 * math.log(2)) * np.eye(2)
    apart, S = z - kalman.x[:2, 0], kalman.P[:2, :2] + R + blur
    return math.sqrt(np.linalg.det(blur) / np.linalg.det(S)) * math.exp(-apart @ np.linalg.inv(S) @ apart / 2)


def believe(label, unresolved, explained):
    """Bayes' rule for being there at all and for being hidden, given how far a measurement is the label's."""
    prior = min(label.mass, 1.0)
    seen = (1 - label.hidden) * (1 - unresolved)
    missed = sum(c.weight * (1 - c.in_view * seen) for c in label.components)
    absent = max(1 - prior, 1e-12)
    label.existence = 1 - absent / (absent + missed + explained / (1 - explained))

    visible = sum(c.weight * c.in_view for c in label.components) / max(prior, 1e-300) * (1 - unresolved)
    unseen = label.hidden + (1 - label.hidden) * max(1 - visible, 0.0)
    label.hidden = (1 - explained) * label.hidden / unseen if unseen > 0 else 0.0


def count(label, pedestrian_probability, stamp_ns, dt_s, params):
    """A hit: what the cameras say of it is news of the class, beside what is still remembered."""
    label.hits += 1
    label.last_hit_ns = stamp_ns
    news = math.log(pedestrian_probability / (1 - pedestrian_probability))
    remembered = label.class_log_odds * math.exp(-dt_s / params.class_memory_s)
    label.class_log_odds = max(-5.0, min(5.0, remembered + news))


def pruned(components, settings):
    """The components worth keeping, with the weight of those that are not."""
    heaviest = max(component.weight for component in components)
    least = max(settings.prune_weight, settings.prune_share * heaviest)
    kept = [component for component in components if component.weight >= least]
    before, after = sum(c.weight for c in components), sum(c.weight for c in kept)
    return [Component(component.weight * before / after, component.kalman) for component in kept]


def merged(components, settings):
    """What lies near the heaviest becomes one with it, then what lies near the next; the last one allowed takes all."""
    rest, out = sorted(components, key=lambda component: -component.weight), []
    while rest:
        pivot, last = rest[0].kalman, len(out) == settings.components_per_label - 1
        apart = [component.kalman.x - pivot.x for component in rest]
        near = [last or (d.T @ np.linalg.inv(pivot.P) @ d).item() < settings.merge_distance for d in apart]
        group = [component for component, joins in zip(rest, near, strict=True) if joins]
        rest = [component for component, joins in zip(rest, near, strict=True) if not joins]
        weight = sum(c.weight for c in group)
        mean = sum(c.weight * c.kalman.x for c in group) / weight
        spread = [c.kalman.P + (c.kalman.x - mean) @ (c.kalman.x - mean).T for c in group]
        cov = sum(c.weight * P for c, P in zip(group, spread, strict=True)) / weight
        out.append(Component(weight, gaussian(mean, cov)))
    return sorted(out, key=lambda component: -component.weight)
