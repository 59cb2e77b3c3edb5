"""Windows of observed and future steps, from annotated clips or from a tracker's output, and batches of them.

Clips are resampled (linear interpolation) to a grid of 10 Hz or the model's own rate. From a clip come clean windows,
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

    observed: FloatArray  # (N, T, 2) m, origin at the scene's mean present position
    velocity: FloatArray  # (N, 2)    m/s at the last observed step
    future: FloatArray  # (N, P, 2) m, same origin; NaN rows where it is not known to the end
    vehicle: FloatArray  # (N, T, 4) x, y, vx, vy of the nearest vehicle, same origin; NaN where there is none
    scene: IntArray  # (N,)    0.., rising
    annotated: BoolArray  # (N,)    clean annotation, which training may add noise to

    def __len__(self) -> int:
        return len(self.scene)

    @property
    def known(self) -> BoolArray:
        """(N,) whether the future is known to the end."""
        return np.asarray(np.isfinite(self.future).all(axis=(1, 2)))


@dataclass(frozen=True)
class WindowSpec:
    """How windows are cut: steps and seconds per step, and the time between two scenes."""

    observed_steps: int
    predicted_steps: int
    dt_s: float
    stride_s: float = 0.2

    @property
    def fine_steps(self) -> int:
        """Grid steps per window step: the grid is the nearest to 10 Hz that divides dt_s."""
        return max(1, round(self.dt_s / SCAN_PERIOD_S))


def training_clip_names(data_dir: Path | None = None) -> tuple[str, ...]:
    """Returns the DUT clips that may be trained on: all but the held-out and the validation ones."""
    excluded = HELD_OUT_CLIPS + VALIDATION_CLIPS
    return tuple(name for name in clip_names("dut", data_dir) if name not in excluded)


def refuse_held_out(names: tuple[str, ...]) -> None:
    """Raises ValueError if a clip is one that nothing may be trained or validated on."""
    bad = sorted({n for n in names if n in HELD_OUT_CLIPS or n.partition("/")[0] in HELD_OUT_DATASETS})
    if bad:
        raise ValueError(f"held-out clips may not be trained or validated on: {', '.join(bad)}")


def weighted_velocity(observed: FloatArray, dt_s: float) -> FloatArray:
    """(..., T, 2) m -> (..., 2) m/s: mean of the displacements, weights 0.5^age, the last having age 0."""
    displacements = np.diff(observed, axis=-2) / dt_s
    weights = 0.5 ** np.arange(displacements.shape[-2])[::-1]
    return np.asarray((displacements * (weights / weights.sum())[:, None]).sum(axis=-2))


def clip_windows(clip: Clip, spec: WindowSpec, noise_m: float = 0.0, rng: np.random.Generator | None = None) -> Windows:
    """Returns the windows of one clip: everyone seen over the whole observation, at every stride.

    Args:
        clip: positions in m.
        spec: the cut.
        noise_m: 0 for clean windows. Else positions get this much noise (standard deviation per axis) and pass
            through an alpha-beta filter with acceleration noise 1 m/s^2, as a tracker's would; futures stay clean.
        rng: needed for noise.

    A clip shorter than the observation gives no windows.
    """
    m, fine_s = spec.fine_steps, spec.dt_s / spec.fine_steps
    true, vehicles = _on_grid(clip, fine_s)  # (G, M, 2), (G, V, 4), NaN where absent
    seen, velocity = true, None
    if noise_m > 0:
        if rng is None:
            raise ValueError("noise_m needs an rng")
        seen, velocity = _alpha_beta(true + rng.normal(0, noise_m, true.shape), noise_m, fine_s)
    T, P = spec.observed_steps, spec.predicted_steps
    starts = np.arange(0, len(true) - m * (T - 1), max(1, round(spec.stride_s / fine_s)))  # (W,)
    observed = _cut(seen, starts, T, m)  # (W, M, T, 2)
    future = _cut(true, starts + m * T, P, m)
    vehicle = _cut(vehicles, starts, T, m)  # (W, V, T, 4)
    wanted = np.isfinite(observed).all(axis=(2, 3))  # (W, M)
    learnable = wanted & np.isfinite(future).all(axis=(2, 3))
    wanted &= learnable.max(axis=1, initial=False)[:, None]  # scenes with at least one known future
    scene, who = np.nonzero(wanted)
    observed, future = observed[scene, who], future[scene, who]  # (N, T, 2), (N, P, 2)
    future[~np.isfinite(future).all(axis=(1, 2))] = np.nan
    present = starts[scene] + m * (T - 1)
    speeds = weighted_velocity(observed, spec.dt_s) if velocity is None else velocity[present, who]
    nearest = _nearest_vehicle(vehicle[scene], observed[:, -1])
    scene = np.unique(scene, return_inverse=True)[1].astype(np.int64)
    return centred(
        observed=observed,
        velocity=speeds,
        future=future,
        vehicle=nearest,
        scene=scene,
        annotated=np.full(len(scene), velocity is None),
    )


def concatenate(parts: list[Windows]) -> Windows:
    """Returns all windows as one set, the scenes numbered on."""
    if not parts:
        raise ValueError("no windows to concatenate")
    offsets = np.cumsum([0] + [int(p.scene[-1]) + 1 if len(p) else 0 for p in parts[:-1]])
    return Windows(
        observed=np.concatenate([p.observed for p in parts]),
        velocity=np.concatenate([p.velocity for p in parts]),
        future=np.concatenate([p.future for p in parts]),
        vehicle=np.concatenate([p.vehicle for p in parts]),
        scene=np.concatenate([p.scene + offset for p, offset in zip(parts, offsets, strict=True)]),
        annotated=np.concatenate([p.annotated for p in parts]),
    )


# --- pieces --------------------------------------------------------------------------------------------------------


def _on_grid(clip: Clip, step_s: float) -> tuple[FloatArray, FloatArray]:
    """Returns pedestrians (G, M, 2) and vehicles (G, V, 4: x, y, vx, vy) every step_s, NaN where they are not seen."""
    frames = [p.frames for p in clip.pedestrians] + [v.frames for v in clip.vehicles]
    if not frames:
        return np.zeros((0, 0, 2)), np.zeros((0, 0, 4))
    begin = min(int(f[0]) for f in frames) / clip.rate_hz
    end = max(int(f[-1]) for f in frames) / clip.rate_hz
    grid_s = begin + step_s * np.arange(int((end - begin) / step_s + 1e-9) + 1)  # (G,)

    def sample(frames: IntArray, columns: FloatArray) -> FloatArray:
        times = frames / clip.rate_hz
        return np.stack([np.interp(grid_s, times, c, left=np.nan, right=np.nan) for c in columns.T], axis=-1)

    pedestrians = [sample(p.frames, p.positions_m) for p in clip.pedestrians]
    vehicles = []
    for v in clip.vehicles:
        velocity = v.speed_mps[:, None] * np.stack([np.cos(v.yaw_rad), np.sin(v.yaw_rad)], axis=-1)
        vehicles.append(sample(v.frames, np.concatenate([v.positions_m, velocity], axis=-1)))
    empty = np.zeros((len(grid_s), 0))
    return (
        np.stack(pedestrians, axis=1) if pedestrians else empty.reshape(len(grid_s), 0, 2),
        np.stack(vehicles, axis=1) if vehicles else empty.reshape(len(grid_s), 0, 4),
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
    velocity: FloatArray,
    future: FloatArray,
    vehicle: FloatArray,
    scene: IntArray,
    annotated: BoolArray,
) -> Windows:
    """Moves each scene's origin to the mean present position, in float64, and then rounds to float32."""
    count = np.bincount(scene) if len(scene) else np.zeros(0)
    origin = np.stack([np.bincount(scene, observed[:, -1, axis]) / count for axis in (0, 1)], axis=-1)[scene]  # (N, 2)
    vehicle = vehicle - np.pad(origin, ((0, 0), (0, 2)))[:, None]
    return Windows(
        observed=(observed - origin[:, None]).astype(np.float32),
        velocity=velocity.astype(np.float32),
        future=(future - origin[:, None]).astype(np.float32),
        vehicle=vehicle.astype(np.float32),
        scene=scene,
        annotated=annotated,
    )
