"""Windows of a tracker's output as .npz files, for `pcgan train --windows`.

Clean annotated tracks are not what a predictor meets in a vehicle. Drives simulated from training clips and run through
the real tracker give windows of track positions and velocities with the true futures; this is their file format.
"""

import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pcgan.dataset import VALIDATION_CLIPS, Windows, WindowSpec, centred, refuse_held_out
from schemas.messages import BoolArray, FloatArray, IntArray

_FORMAT = 2


class WindowsError(ValueError):
    """A file of windows that cannot be used; the message says what differs."""


def save_windows(
    path: Path,
    *,
    observed: FloatArray,
    seen: BoolArray,
    velocity: FloatArray,
    future: FloatArray,
    scene: IntArray,
    vehicle: FloatArray,
    clips: list[str],
    dt_s: float,
) -> None:
    """Writes a tracker's windows as .npz, which `load_windows` reads; raises WindowsError for shapes that disagree.

    Args:
        path: the file to write.
        observed: (N, T, 2) track positions in m, any origin, filled in where not seen.
        seen: (N, T) at which steps.
        velocity: (N, 2) the tracks' present velocity in m/s.
        future: (N, P, 2) ground truth in m; NaN where it is not known.
        scene: (N,) 0..S-1, which frame of which drive, rising.
        vehicle: (S, T, 4) x, y, vx, vy; NaN where there is none.
        clips: S names of the clips the scenes were simulated from, e.g. "dut/roundabout_02"; they decide which
            windows validate. Held-out ones raise ValueError.
        dt_s: seconds per step.
    """
    val = np.array([clip in VALIDATION_CLIPS for clip in clips], bool)
    arrays: dict[str, NDArray[Any]] = {
        "observed": np.asarray(observed, np.float64),
        "seen": np.asarray(seen, bool),
        "velocity": np.asarray(velocity, np.float64),
        "future": np.asarray(future, np.float64),
        "scene": np.asarray(scene, np.int64),
        "vehicle": np.asarray(vehicle, np.float64),
        "validation": val,
        "clip": np.array(clips, np.str_),
        "dt_s": np.array(dt_s, np.float64),
        "format": np.array(_FORMAT),
    }
    _check_arrays(path, arrays)
    with path.open("wb") as stream:
        np.savez_compressed(stream, allow_pickle=False, **arrays)


def load_windows(path: Path, spec: WindowSpec) -> tuple[Windows, Windows]:
    """Returns the training and the validation windows of an .npz file; scenes without a known future are dropped.

    Raises WindowsError naming the file and what differs (arrays, shapes, dt_s, NaN), ValueError for held-out clips.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        raise WindowsError(f"{path} is not a readable .npz of windows: {error}") from error
    _check_arrays(path, arrays)
    found = (arrays["observed"].shape[1], arrays["future"].shape[1], float(arrays["dt_s"]))
    wanted = (spec.observed_steps, spec.predicted_steps, spec.dt_s)
    if found[:2] != wanted[:2] or abs(found[2] - wanted[2]) > 1e-9:
        raise WindowsError(f"{path} has (observed steps, predicted steps, dt_s) {found}; the model needs {wanted}")
    scene, future = arrays["scene"], arrays["future"]
    known = np.isfinite(future).all(axis=2).any(axis=1)
    learnable = np.zeros(len(arrays["vehicle"]), bool)
    learnable[scene[known]] = True
    parts = []
    for validation in (False, True):
        chosen = (learnable & (arrays["validation"] == validation))[scene]
        parts.append(
            centred(
                observed=arrays["observed"][chosen],
                seen=arrays["seen"][chosen],
                velocity=arrays["velocity"][chosen],
                future=future[chosen],
                vehicle=arrays["vehicle"][scene[chosen]],
                scene=np.unique(scene[chosen], return_inverse=True)[1].astype(np.int64),
                annotated=np.zeros(int(chosen.sum()), bool),
                dt_s=spec.dt_s,
            )
        )
    return parts[0], parts[1]


def _check_arrays(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    names = {"observed", "seen", "velocity", "future", "scene", "vehicle", "validation", "clip", "dt_s", "format"}
    if missing := sorted(names - arrays.keys()):
        raise WindowsError(f"{path} lacks the arrays {missing}")
    if int(arrays["format"]) != _FORMAT:
        raise WindowsError(f"{path} is of windows format {int(arrays['format'])}; this version reads {_FORMAT}")
    N, S = len(arrays["scene"]), len(arrays["vehicle"])
    if arrays["observed"].ndim != 3 or arrays["future"].ndim != 3:
        raise WindowsError(f"{path}: observed and future must have shape (N, steps, 2)")
    T, P = arrays["observed"].shape[1], arrays["future"].shape[1]
    wanted = {
        "observed": (N, T, 2), "seen": (N, T), "velocity": (N, 2), "future": (N, P, 2), "vehicle": (S, T, 4),
        "validation": (S,), "clip": (S,),
    }  # fmt: skip
    for name, shape in wanted.items():
        if arrays[name].shape != shape:
            raise WindowsError(f"{path}: {name} must have shape {shape}, got {arrays[name].shape}")
    scene = arrays["scene"]
    if N and (scene.min() < 0 or scene.max() >= S or (np.diff(scene) < 0).any()):
        raise WindowsError(f"{path}: scene must rise and stay within 0 to {S - 1}")
    for name in ("observed", "velocity"):
        if not np.isfinite(arrays[name]).all():
            raise WindowsError(f"{path}: {name} holds NaN or infinity")
    if N and not (arrays["seen"][:, -1] & (arrays["seen"].sum(axis=1) >= 2)).all():
        raise WindowsError(f"{path}: everybody must be seen at the last step and at an earlier one")
    refuse_held_out(tuple(str(clip) for clip in np.unique(arrays["clip"])))
