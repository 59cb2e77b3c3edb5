"""Recent states at evenly spaced times: interpolated between stamped samples, never extrapolated."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pcgan.dataset import filled_in
from schemas.messages import BoolArray, FloatArray, IntArray, Track, VehicleHistory

MAX_GAP_NS = 1_000_000_000  # a straight line over a longer gap says nothing about how somebody walked
_OWNER_NS = 1 << 40  # 18 minutes: farther apart than any samples of one history that count


def observations(tracks: Sequence[Track], times_ns: IntArray) -> tuple[FloatArray, BoolArray, BoolArray]:
    """Returns what a network observes of the tracks of a frame, as windows are made of it and as predictions are.

    The last step is the track's present state, which is there even if the last scan missed somebody; earlier ones are
    interpolated in its history.

    Args:
        tracks: A tracks with their histories.
        times_ns: (T,) rising; the last is the frame's stamp.

    Returns:
        observed (A, T, 2) m in the tracks' frame, filled in where not seen; seen (A, T); and (A,) who can be predicted:
        not coasting, and seen at an earlier step too.
    """
    if not tracks:
        return np.zeros((0, len(times_ns), 2)), np.zeros((0, len(times_ns)), bool), np.zeros(0, bool)
    observed, seen = track_positions(tracks, times_ns)
    observed[:, -1] = [track.state[:2] for track in tracks]
    seen[:, -1] = True
    usable = (seen.sum(axis=1) >= 2) & ~np.array([track.coasting for track in tracks], bool)
    return filled_in(observed, seen), seen, usable


def track_positions(tracks: Sequence[Track], times_ns: IntArray) -> tuple[FloatArray, BoolArray]:
    """Returns tracks' positions at the given times and at which of them each track was seen.

    Args:
        tracks: A tracks with their histories; samples marked as coasting do not count.
        times_ns: (T,) rising.

    Returns:
        (A, T, 2) m in the tracks' frame, meaningless where not seen, and (A, T) bool.
    """
    if not tracks:
        return np.zeros((0, len(times_ns), 2)), np.zeros((0, len(times_ns)), bool)
    histories = [track.history for track in tracks]
    counts = [len(history.stamps_ns) for history in histories]
    coasting = np.concatenate([history.coasting for history in histories])
    stamps = np.concatenate([history.stamps_ns for history in histories])
    positions = np.concatenate([history.states for history in histories])[:, :2]
    owners = np.repeat(np.arange(len(tracks)), counts)
    if coasting.any():
        measured = ~coasting
        stamps, positions, owners = stamps[measured], positions[measured], owners[measured]
    return _interpolate(stamps, positions, owners, len(tracks), times_ns)


def vehicle_states(history: VehicleHistory, times_ns: IntArray) -> FloatArray | None:
    """Returns the vehicle's x, y, vx, vy (T, 4) at the given times (T,), or None if it was not seen at all of them."""
    owners = np.zeros(len(history.stamps_ns), np.int64)
    states, covered = _interpolate(history.stamps_ns, history.states[:, [0, 1, 3, 4]], owners, 1, times_ns)
    return states[0] if covered[0].all() else None


def _interpolate(
    stamps_ns: IntArray, values: FloatArray, owners: IntArray, count: int, times_ns: IntArray
) -> tuple[FloatArray, BoolArray]:
    """(H,), (H, C), (H,) owners 0..count-1, rising, each with rising stamps -> (count, T, C), (count, T) bool.

    All owners in one search: stamps relative to the last time, each owner's in a stretch of its own.
    """
    T, C = len(times_ns), values.shape[1]
    relative = stamps_ns - times_ns[-1]
    near = np.abs(relative) < _OWNER_NS // 2
    if not near.all():
        relative, values, owners = relative[near], values[near], owners[near]
    if len(relative) == 0:
        return np.zeros((count, T, C)), np.zeros((count, T), bool)
    keys: NDArray[np.int64] = owners * _OWNER_NS + relative  # (H,) rising
    wanted = np.arange(count)[:, None] * _OWNER_NS + (times_ns - times_ns[-1])  # (count, T)
    after = np.searchsorted(keys, wanted)  # the first sample not before
    inside = after < len(keys)
    after = np.minimum(after, len(keys) - 1)
    before = np.where(keys[after] == wanted, after, after - 1)
    inside &= before >= 0
    span = keys[after] - keys[before]  # of two owners' samples: at least half a stretch, so refused as a gap
    covered = inside & (span >= 0) & (span <= MAX_GAP_NS)
    fraction = ((wanted - keys[before]) / np.maximum(span, 1))[..., None]
    return values[before] + fraction * (values[after] - values[before]), covered
