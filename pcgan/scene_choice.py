"""Scenes worth a picture: the kinds that the paper shows, found in windows by a rule and not by hand.

Each kind has a score, and the scene that scores highest is taken, so the same windows give the same scene. All who take
part are seen throughout the observation and their future is known to the end.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import torch

from pcgan.batches import Observation
from pcgan.dataset import Windows
from pcgan.scores import scorable
from schemas.messages import BoolArray, FloatArray, IntArray

_WALKING_MPS = 0.5
_CROWD = 8  # people in focus, beyond whom a picture gets hard to read


@dataclass(frozen=True, eq=False)
class Scene:
    """Everybody at one moment, and whom the picture is about."""

    observed: FloatArray  # (A, T, 2) m
    seen: BoolArray  # (A, T)
    velocity: FloatArray  # (A, 2) m/s
    future: FloatArray  # (A, P, 2) m, NaN where not known
    vehicle: FloatArray  # (A, T, 4) x, y, vx, vy of each one's nearest, NaN where there is none
    focus: IntArray  # (F,) of A
    dt_s: float

    def observation(self) -> Observation:
        """Returns what a method may see of it: one scene, without a leading axis."""
        A = len(self.observed)
        return Observation(
            observed=torch.from_numpy(self.observed),
            seen=torch.from_numpy(self.seen),
            velocity=torch.from_numpy(self.velocity),
            neighbours=torch.ones(A, A, dtype=torch.bool),
            vehicle=torch.from_numpy(self.vehicle),
        )


def oncoming_pair(windows: Windows) -> Scene | None:
    """Returns the scene of two people who walk towards each other; None if there is none.

    They are 2 to 8 m apart, head-on to within 25 degrees, and would pass each other at less than 1 m within the time
    predicted. Of such pairs the one that swerves most is taken, with few others around.
    """
    best: tuple[float, Scene] | None = None
    horizon_s = windows.future.shape[1] * windows.dt_s
    for scene in _scenes(windows):
        who, position, velocity = _walkers(scene, windows)
        heading = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
        offset = position[None] - position[:, None]  # (W, W, 2) from i to j
        distance = np.linalg.norm(offset, axis=-1)
        closing = velocity[:, None] - velocity[None]  # (W, W, 2) of i as j sees it
        square = (closing**2).sum(axis=-1) + 1e-9
        meet_s = (offset * closing).sum(axis=-1) / square
        pass_m = np.abs(offset[..., 0] * closing[..., 1] - offset[..., 1] * closing[..., 0]) / np.sqrt(square)
        fits = (distance > 2) & (distance < 8) & (heading @ heading.T < -np.cos(np.radians(25)))
        fits &= (meet_s > 0) & (meet_s < horizon_s) & (pass_m < 1)
        swerve = np.minimum(_swerves(scene.future[who], position, velocity), 1.0)
        for i, j in np.argwhere(np.triu(fits)):
            focus = who[[i, j]]
            best = _better(best, swerve[i] + swerve[j] - pass_m[i, j] - _crowding(scene, focus), scene, focus)
    return best[1] if best else None


def turning_group(windows: Windows) -> Scene | None:
    """Returns the scene of people who walk side by side and turn together; None if there is none.

    They are within 2 m of one another, head the same way to within 20 degrees, and end up heading more than 30 degrees
    to the same side. Of such groups the one that turns most is taken, up to 90 degrees, a third of it while observed.
    """
    best: tuple[float, Scene] | None = None
    for scene in _scenes(windows):
        who, position, _ = _walkers(scene, windows)
        if len(who) < 2:
            continue
        track = np.concatenate([scene.observed, scene.future], axis=1)[who]  # (W, T + P, 2)
        T = scene.observed.shape[1]
        before = _angle(track[:, T // 2] - track[:, 0])
        now = _angle(track[:, T - 1] - track[:, T // 2])
        leg = track[:, -1] - track[:, -1 - scene.future.shape[1] // 3]
        after = _angle(leg)
        turn = _wrapped(after - before)  # (W,)
        begun = np.sign(turn) * _wrapped(now - before)
        walks_on = np.linalg.norm(leg, axis=1) > _WALKING_MPS * windows.dt_s * scene.future.shape[1] // 3
        turns = (np.abs(turn) > np.radians(30)) & (np.abs(turn) < np.radians(120)) & (begun > 0) & walks_on
        distance = np.linalg.norm(position[None] - position[:, None], axis=-1)
        together = (distance < 2) & (np.abs(_wrapped(before[None] - before[:, None])) < np.radians(20))
        together &= turns & turns[:, None] & (np.sign(turn) == np.sign(turn)[:, None])
        for i in np.flatnonzero(together.sum(axis=1) > 1):
            group = np.flatnonzero(together[i])
            size = np.minimum(np.abs(turn[group]), np.pi / 2).min() + np.minimum(begun[group].min(), np.pi / 6)
            best = _better(best, float(size) - _crowding(scene, who[group]), scene, who[group])
    return best[1] if best else None


def vehicle_from_behind(windows: Windows) -> Scene | None:
    """Returns the scene of a vehicle that comes up behind people who walk in its way; None if there is none.

    It drives faster than 1 m/s and than they walk, in their direction to within 30 degrees; its middle is 4 to 20 m
    behind them and less than 2.5 m to the side. Of such scenes the one where somebody swerves most, and is nearest, is
    taken.
    """
    best: tuple[float, Scene] | None = None
    for scene in _scenes(windows):
        who, position, velocity = _walkers(scene, windows)
        state = scene.vehicle[who, -1]  # (W, 4)
        speed = np.linalg.norm(state[:, 2:], axis=1)
        with np.errstate(invalid="ignore"):
            ahead = state[:, 2:] / np.maximum(speed, 1e-9)[:, None]  # NaN without a vehicle
            walk = np.linalg.norm(velocity, axis=1)
            along = (velocity * ahead).sum(axis=1) / walk
            offset = position - state[:, :2]
            behind_m = (offset * ahead).sum(axis=1)
            beside_m = np.abs(offset[:, 0] * ahead[:, 1] - offset[:, 1] * ahead[:, 0])
            fits = (speed > np.maximum(walk, 1)) & (along > np.cos(np.radians(30)))
            fits &= (behind_m > 4) & (behind_m < 20) & (beside_m < 2.5)
        if fits.any():
            swerve = np.minimum(_swerves(scene.future[who], position, velocity), 1.0)
            score = np.where(fits, swerve - 0.03 * behind_m - 0.1 * beside_m, -np.inf)
            first = int(score.argmax())
            best = _better(best, float(score[first]), scene, who[fits])
    return best[1] if best else None


def busiest(windows: Windows) -> Scene | None:
    """Returns the scene in which most people walk within 6 m of one another, up to 8; None if nobody walks."""
    best: tuple[float, Scene] | None = None
    for scene in _scenes(windows):
        who, position, _ = _walkers(scene, windows)
        near = np.linalg.norm(position[None] - position[:, None], axis=-1) < 6
        for i in range(len(who)):
            focus = who[near[i]]
            if len(focus) <= _CROWD:
                best = _better(best, len(focus) - _crowding(scene, focus), scene, focus)
    return best[1] if best else None


def _scenes(windows: Windows) -> Iterator[Scene]:
    """Yields every scene, everybody in focus who is scored."""
    scored = scorable(windows, windows.future.shape[1])
    edges = np.flatnonzero(np.diff(windows.scene, prepend=-1, append=-1))
    for first, last in pairwise(edges):
        rows = slice(int(first), int(last))
        if scored[rows].any():
            yield Scene(
                windows.observed[rows],
                windows.seen[rows],
                windows.velocity[rows],
                windows.future[rows],
                windows.vehicle[rows],
                np.flatnonzero(scored[rows]),
                windows.dt_s,
            )


def _walkers(scene: Scene, windows: Windows) -> tuple[IntArray, FloatArray, FloatArray]:
    """Returns who in focus walks, where they are and how fast: (W,), (W, 2) m, (W, 2) m/s."""
    observed = scene.observed[scene.focus]
    velocity = (observed[:, -1] - observed[:, 0]) / (windows.dt_s * (observed.shape[1] - 1))
    walks = np.linalg.norm(velocity, axis=1) > _WALKING_MPS
    return scene.focus[walks], observed[walks, -1], velocity[walks]


def _swerves(future: FloatArray, position: FloatArray, velocity: FloatArray) -> FloatArray:
    """(W, P, 2), (W, 2), (W, 2) -> (W,): how far people stray sideways from where they were heading, in m."""
    offset = future - position[:, None]
    heading = velocity / np.linalg.norm(velocity, axis=1, keepdims=True)
    sideways = offset[..., 0] * heading[:, None, 1] - offset[..., 1] * heading[:, None, 0]
    return np.asarray(np.abs(sideways).max(axis=1))


def _crowding(scene: Scene, focus: IntArray) -> float:
    """Returns what other people around the focus cost a scene: 0.1 each within 5 m."""
    present = scene.observed[:, -1]
    near = np.linalg.norm(present - present[focus].mean(axis=0), axis=1) < 5
    return 0.1 * float(near.sum() - len(focus))


def _better(best: tuple[float, Scene] | None, score: float, scene: Scene, focus: IntArray) -> tuple[float, Scene]:
    """Returns the better of the best so far and a scene with this focus; of equal ones the first."""
    if best is not None and best[0] >= score:
        return best
    return score, replace(scene, focus=focus)


def _angle(vector: FloatArray) -> FloatArray:
    return np.asarray(np.arctan2(vector[..., 1], vector[..., 0]))


def _wrapped(angle: FloatArray) -> FloatArray:
    return np.asarray((angle + np.pi) % (2 * np.pi) - np.pi)
