"""Windows of observed and future steps: the one representation that every predictor learns from and is scored on.

Annotated clips are resampled (linear interpolation) to a grid of 10 Hz or the model's own rate; where the annotation
has the model's rate, it is taken as it is. A window holds everybody who is there at its last observed step and was seen
at least once before: not all have been seen throughout, and not all stay to the end. From a clip come clean windows,
whose present velocity is the weighted mean of the observed displacements, and on request windows as a tracker would see
them: noisy positions run through the steady-state alpha-beta filter (Kalata 1984) of the tracker's motion model.

Windows of our own tracker over simulated drives arrive as .npz (pcgan/windows_file.py).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from pcgan.clips import Clip, clip_names
from schemas.messages import BoolArray, FloatArray, IntArray

# Nobody trains or validates on these: replays are scored on them (DESIGN section 7). All of CITR is held out as well.
HELD_OUT_CLIPS = ("dut/roundabout_04", "dut/intersection_08")
HELD_OUT_DATASETS = ("citr",)
# A fifth of the other clips' pedestrians, by clip: three crossings from sparse to crowded, a one-vehicle roundabout and
# one with several vehicles.
VALIDATION_CLIPS = (
    "dut/intersection_06",
    "dut/intersection_10",
    "dut/intersection_17",
    "dut/roundabout_02",
    "dut/roundabout_07",
)
SCAN_PERIOD_S = 0.1
_BURN_IN_STEPS = 5  # a filter's first steps are dropped


@dataclass(frozen=True, eq=False)
class Windows:
    """N observed pedestrians, each in a scene with those seen at the same time; sorted by scene, float32."""

    observed: FloatArray  # (N, T, 2) m, origin at the scene's mean present position; filled in where not seen
    seen: BoolArray  # (N, T)    whether somebody was seen at that step; at the last one and at an earlier one always
    velocity: FloatArray  # (N, 2)    m/s at the last observed step
    future: FloatArray  # (N, P, 2) m, same origin; NaN where it is not known
    vehicle: FloatArray  # (N, T, 4) x, y, vx, vy of the nearest vehicle, same origin; NaN where there is none
    scene: IntArray  # (N,)    0.., rising
    annotated: BoolArray  # (N,)    clean annotation, which training may add noise to
    dt_s: float  # seconds per step

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def known(self) -> BoolArray:
        """(N, P) at which steps the future is known."""
        return np.asarray(np.isfinite(self.future).all(axis=2))

    @property
    def complete(self) -> BoolArray:
        """(N,) who was seen at every observed step."""
        return np.asarray(self.seen.all(axis=1))

    def select(self, rows: BoolArray) -> "Windows":
        """Returns the pedestrians where `rows` (N,) is true, scenes numbered anew."""
        return Windows(
            observed=self.observed[rows],
            seen=self.seen[rows],
            velocity=self.velocity[rows],
            future=self.future[rows],
            vehicle=self.vehicle[rows],
            scene=np.unique(self.scene[rows], return_inverse=True)[1].astype(np.int64),
            annotated=self.annotated[rows],
            dt_s=self.dt_s,
        )


@dataclass(frozen=True)
class WindowSpec:
    """How windows are cut: steps and seconds per step, and the time between two scenes."""

    observed_steps: int
    predicted_steps: int
    dt_s: float
    stride_s: float = 0.2
    known_steps: int | None = None  # a scene is kept if somebody's future is known this far; None: to the end
    most_vehicles: int | None = None  # a scene is left out if more are seen at any of its steps

    def fine_steps(self, rate_hz: float) -> int:
        """Grid steps per window step: the grid is the nearest to 10 Hz, or to a slower clip's, that divides dt_s."""
        return max(1, round(self.dt_s * min(rate_hz, 1 / SCAN_PERIOD_S)))


def training_clip_names(data_dir: Path | None = None) -> tuple[str, ...]:
    """Returns the DUT clips that may be trained on: all but the held-out and the validation ones."""
    excluded = HELD_OUT_CLIPS + VALIDATION_CLIPS
    return tuple(name for name in clip_names("dut", data_dir) if name not in excluded)


def refuse_held_out(names: tuple[str, ...]) -> None:
    """Raises ValueError if a clip is one that nothing may be trained or validated on."""
    bad = sorted({n for n in names if n in HELD_OUT_CLIPS or n.partition("/")[0] in HELD_OUT_DATASETS})
    if bad:
        raise ValueError(f"held-out clips may not be trained or validated on: {', '.join(bad)}")


def weighted_velocity(observed: FloatArray, dt_s: float, seen: BoolArray | None = None) -> FloatArray:
    """(..., T, 2) m -> (..., 2) m/s: mean of the displacements, weights 0.5^age, the last having age 0.

    With `seen` (..., T), displacements from before the first seen step, which only fill in, do not count.
    """
    displacements = np.diff(observed, axis=-2) / dt_s
    weights = np.broadcast_to(0.5 ** np.arange(displacements.shape[-2])[::-1], displacements.shape[:-1])
    if seen is not None:
        weights = weights * np.maximum.accumulate(seen, axis=-1)[..., :-1]
    return np.asarray((displacements * (weights / weights.sum(axis=-1, keepdims=True))[..., None]).sum(axis=-2))


def clip_windows(clip: Clip, spec: WindowSpec, noise_m: float = 0.0, rng: np.random.Generator | None = None) -> Windows:
    """Returns the windows of one clip: at every stride, everyone seen at the last observed step and at an earlier one.

    Args:
        clip: positions in m.
        spec: the cut.
        noise_m: 0 for clean windows. Else positions get this much noise (standard deviation per axis) and pass
            through an alpha-beta filter with acceleration noise 1 m/s^2, as a tracker's would; futures stay clean.
        rng: needed for noise.

    A clip shorter than the observation gives no windows.
    """
    m = spec.fine_steps(clip.rate_hz)
    fine_s = spec.dt_s / m
    true, vehicles = _on_grid(clip, fine_s)  # (G, M, 2), (G, V, 4), NaN where absent
    measured, velocity = true, None
    if noise_m > 0:
        if rng is None:
            raise ValueError("noise_m needs an rng")
        measured, velocity = _alpha_beta(true + rng.normal(0, noise_m, true.shape), noise_m, fine_s)
    T, P = spec.observed_steps, spec.predicted_steps
    starts = np.arange(0, len(true) - m * (T - 1), max(1, round(spec.stride_s / fine_s)))  # (W,)
    observed = _cut(measured, starts, T, m)  # (W, M, T, 2)
    future = _cut(true, starts + m * T, P, m)
    vehicle = _cut(vehicles, starts, T + P, m)  # (W, V, T + P, 4)
    seen: BoolArray = np.asarray(np.isfinite(observed).all(axis=3))  # (W, M, T)
    wanted = seen[:, :, -1] & (seen.sum(axis=2) >= 2)  # (W, M)
    learnable = wanted & np.isfinite(future[:, :, : spec.known_steps]).all(axis=(2, 3))
    wanted &= learnable.max(axis=1, initial=False)[:, None]
    if spec.most_vehicles is not None:
        met: BoolArray = np.asarray(np.isfinite(vehicle).all(axis=3))  # (W, V, T + P)
        wanted &= (met.any(axis=2).sum(axis=1) <= spec.most_vehicles)[:, None]
    scene, who = np.nonzero(wanted)
    seen = seen[scene, who]
    observed = filled_in(observed[scene, who], seen)  # (N, T, 2)
    present = starts[scene] + m * (T - 1)
    speeds = weighted_velocity(observed, spec.dt_s, seen) if velocity is None else velocity[present, who]
    nearest = _nearest_vehicle(vehicle[scene][:, :, :T], observed[:, -1])
    return centred(
        observed=observed,
        seen=seen,
        velocity=speeds,
        future=future[scene, who],
        vehicle=nearest,
        scene=np.unique(scene, return_inverse=True)[1].astype(np.int64),
        annotated=np.full(len(scene), velocity is None),
        dt_s=spec.dt_s,
    )


def filled_in(observed: FloatArray, seen: BoolArray) -> FloatArray:
    """(N, T, 2) m, (N, T) -> (N, T, 2): unseen steps between seen ones interpolated, those before the first like it."""
    if seen.all():
        return observed
    T = seen.shape[1]
    index = np.arange(T)
    before = np.maximum.accumulate(np.where(seen, index, -1), axis=1)  # (N, T) the last seen step up to here
    after = np.minimum.accumulate(np.where(seen, index, T)[:, ::-1], axis=1)[:, ::-1]
    after = np.minimum(after, T - 1)  # the last step is always seen
    before = np.where(before < 0, after, before)
    row = np.arange(len(observed))[:, None]
    fraction = (index - before) / np.maximum(after - before, 1)
    start, end = observed[row, before], observed[row, after]
    return np.asarray(start + fraction[..., None] * (end - start))


def reversed_in_time(windows: Windows) -> Windows:
    """Returns the windows with time run backwards, as more people to learn from; without vehicles.

    Whoever is not there at the new last observed step, or at no other observed one, drops out.
    """
    T = windows.observed.shape[1]
    positions = np.concatenate([windows.observed, windows.future], axis=1)[:, ::-1]  # (N, T + P, 2)
    there = np.concatenate([windows.seen, windows.known], axis=1)[:, ::-1]
    wanted = there[:, T - 1] & (there[:, :T].sum(axis=1) >= 2)
    positions, there = positions[wanted].astype(np.float64), there[wanted]
    observed = filled_in(positions[:, :T], there[:, :T])
    return centred(
        observed=observed,
        seen=there[:, :T],
        velocity=weighted_velocity(observed, windows.dt_s, there[:, :T]),
        future=np.where(there[:, T:, None], positions[:, T:], np.nan),
        vehicle=np.full_like(windows.vehicle[wanted], np.nan),
        scene=np.unique(windows.scene[wanted], return_inverse=True)[1].astype(np.int64),
        annotated=windows.annotated[wanted],
        dt_s=windows.dt_s,
    )


def concatenate(parts: list[Windows]) -> Windows:
    """Returns all windows as one set, the scenes numbered on; raises ValueError if steps or dt_s differ."""
    if not parts:
        raise ValueError("no windows to concatenate")
    kinds = {(p.observed.shape[1], p.future.shape[1], p.dt_s) for p in parts}
    if len(kinds) > 1:
        raise ValueError(f"windows of different (observed steps, predicted steps, dt_s): {sorted(kinds)}")
    offsets = np.cumsum([0] + [int(p.scene[-1]) + 1 if len(p) else 0 for p in parts[:-1]])
    return Windows(
        observed=np.concatenate([p.observed for p in parts]),
        seen=np.concatenate([p.seen for p in parts]),
        velocity=np.concatenate([p.velocity for p in parts]),
        future=np.concatenate([p.future for p in parts]),
        vehicle=np.concatenate([p.vehicle for p in parts]),
        scene=np.concatenate([p.scene + offset for p, offset in zip(parts, offsets, strict=True)]),
        annotated=np.concatenate([p.annotated for p in parts]),
        dt_s=parts[0].dt_s,
    )


# --- pieces --------------------------------------------------------------------------------------------------------


def _on_grid(clip: Clip, step_s: float) -> tuple[FloatArray, FloatArray]:
    """Returns pedestrians (G, M, 2) and vehicles (G, V, 4: x, y, vx, vy) every step_s, NaN where they are not seen."""
    frames = [p.frames for p in clip.pedestrians] + [v.frames for v in clip.vehicles]
    if not frames:
        return np.zeros((0, 0, 2)), np.zeros((0, 0, 4))
    step = step_s * clip.rate_hz  # in frames
    step = round(step) if abs(step - round(step)) < 1e-6 else step  # where the grid is the annotation's: exactly
    begin, end = min(int(f[0]) for f in frames), max(int(f[-1]) for f in frames)
    grid = begin + step * np.arange(int((end - begin) / step + 1e-9) + 1)  # (G,)

    def sample(frames: IntArray, columns: FloatArray) -> FloatArray:
        return np.stack([np.interp(grid, frames, c, left=np.nan, right=np.nan) for c in columns.T], axis=-1)

    pedestrians = [sample(p.frames, p.positions_m) for p in clip.pedestrians]
    vehicles = []
    for v in clip.vehicles:
        velocity = v.speed_mps[:, None] * np.stack([np.cos(v.yaw_rad), np.sin(v.yaw_rad)], axis=-1)
        vehicles.append(sample(v.frames, np.concatenate([v.positions_m, velocity], axis=-1)))
    empty = np.zeros((len(grid), 0))
    return (
        np.stack(pedestrians, axis=1) if pedestrians else empty.reshape(len(grid), 0, 2),
        np.stack(vehicles, axis=1) if vehicles else empty.reshape(len(grid), 0, 4),
    )


def _alpha_beta(measured: FloatArray, noise_m: float, step_s: float) -> tuple[FloatArray, FloatArray]:
    """Returns filtered positions and velocities (G, M, 2), NaN for each track's first steps.

    The steady state of a constant-velocity Kalman filter with acceleration noise 1 m/s^2 (tracking index of Kalata,
    The tracking index, 1984). Tracks are contiguous in time.
    """
    index = 1.0 * step_s**2 / noise_m
    r = (4 + index - np.sqrt(8 * index + index**2)) / 4
    alpha = 1 - r * r
    beta = 2 * (2 - alpha) - 4 * np.sqrt(1 - alpha)
    position, velocity = np.full_like(measured, np.nan), np.full_like(measured, np.nan)
    age = np.zeros(measured.shape[1], np.int64)
    x, v = np.zeros(measured.shape[1:]), np.zeros(measured.shape[1:])
    for step, z in enumerate(measured):  # (M, 2)
        here = np.isfinite(z).all(axis=-1)
        if step + 1 < len(measured):  # a new track starts with its first two measurements' velocity
            guess = np.nan_to_num((measured[min(step + 3, len(measured) - 1)] - z) / (3 * step_s))
        new = here & (age == 0)
        x[new], v[new] = z[new], guess[new]
        old = here & (age > 0)
        predicted = x[old] + step_s * v[old]
        residual = z[old] - predicted
        x[old], v[old] = predicted + alpha * residual, v[old] + beta / step_s * residual
        age = np.where(here, age + 1, 0)
        ready = age > _BURN_IN_STEPS
        position[step, ready], velocity[step, ready] = x[ready], v[ready]
    return position, velocity


def _cut(dense: FloatArray, starts: IntArray, steps: int, every: int) -> FloatArray:
    """(G, M, C) -> (W, M, steps, C): from each start `steps` samples, `every` apart; NaN past the end."""
    length = every * (steps - 1) + 1
    last = int(starts[-1]) + length if len(starts) else 0
    padded = np.pad(dense, ((0, max(0, last - len(dense))), (0, 0), (0, 0)), constant_values=np.nan)
    if not len(starts):
        return np.zeros((0, dense.shape[1], steps, dense.shape[2]))
    views = sliding_window_view(padded, length, axis=0)[starts, :, :, ::every]  # (W, M, C, steps)
    return np.ascontiguousarray(views.swapaxes(2, 3))


def _nearest_vehicle(vehicles: FloatArray, present: FloatArray) -> FloatArray:
    """(N, V, T, 4), (N, 2) -> (N, T, 4): the nearest vehicle seen over the whole observation, NaN if there is none."""
    N, V, T, _ = vehicles.shape
    if V == 0:
        return np.full((N, T, 4), np.nan)
    distance = np.linalg.norm(vehicles[:, :, -1, :2] - present[:, None], axis=-1)  # (N, V)
    distance = np.where(np.isfinite(vehicles).all(axis=(2, 3)), distance, np.inf)
    nearest = distance.argmin(axis=1)
    chosen: FloatArray = vehicles[np.arange(N), nearest].copy()
    chosen[~np.isfinite(distance[np.arange(N), nearest])] = np.nan
    return chosen


def centred(
    *,
    observed: FloatArray,
    seen: BoolArray,
    velocity: FloatArray,
    future: FloatArray,
    vehicle: FloatArray,
    scene: IntArray,
    annotated: BoolArray,
    dt_s: float,
) -> Windows:
    """Moves each scene's origin to the mean present position, in float64, and then rounds to float32."""
    count = np.bincount(scene) if len(scene) else np.zeros(0)
    origin = np.stack([np.bincount(scene, observed[:, -1, axis]) / count for axis in (0, 1)], axis=-1)[scene]  # (N, 2)
    vehicle = vehicle - np.pad(origin, ((0, 0), (0, 2)))[:, None]
    return Windows(
        observed=(observed - origin[:, None]).astype(np.float32),
        seen=seen,
        velocity=velocity.astype(np.float32),
        future=(future - origin[:, None]).astype(np.float32),
        vehicle=vehicle.astype(np.float32),
        scene=scene,
        annotated=annotated,
        dt_s=dt_s,
    )
