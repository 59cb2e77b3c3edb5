"""What if the vehicle drove otherwise: one moment of a drive, predicted as it drives on and under a supposed path.

The network sees how the vehicle came here and not where it is going. So people are predicted to walk the same in both
futures; what differs is the corridor, and with it who enters it, how probably and when.
"""

import csv
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import zenoh

from pcgan import vehicle_path
from pcgan.bus import ENCODING
from pcgan.predictor_process import what_if_key
from pcgan.vehicle_path import ManoeuvreError, Motion, motion_at
from replay.errors import LogError, PredictorError, ReplayError
from replay.frame_result import FrameResult
from replay.session import Replay
from schemas import codec
from schemas.codec import LARGEST, CodecError
from schemas.messages import FloatArray, Prediction, PredictionFrame, TrackFrame, VehiclePath

NEAREST_S = 1.0  # a moment's frame is at most so far from it
STEP_S = 0.1  # between the poses of a supposed path
LIKELY = 0.01  # who enters less probably than this is of no interest
RETRY_S = 0.1
COLUMNS = ("t", "x", "y", "yaw")

Predict = Callable[[TrackFrame], PredictionFrame]


class WhatIfError(ReplayError):
    """A supposed path that makes no sense."""


class Hypothesis(NamedTuple):
    """What the vehicle is supposed to do instead of driving on."""

    name: str  # as a verb: "brakes"
    figures: dict[str, object]  # for the JSON
    path: Callable[[Motion, FloatArray], VehiclePath]  # from the present motion and the times (S,) until the horizon


@dataclass(frozen=True, eq=False)
class Future:
    """What the vehicle does, and what is predicted then."""

    name: str  # as a verb
    path: VehiclePath
    answer: PredictionFrame


@dataclass(frozen=True, eq=False)
class WhatIf:
    """One moment of a drive and its two futures."""

    tracks: TrackFrame
    motion: Motion
    horizon_s: float
    driven_on: Future
    supposed: Future


@dataclass(frozen=True)
class Entry:
    """How probably, and when, somebody enters the vehicle's corridor."""

    probability: float
    time_s: float | None


@dataclass(frozen=True)
class Pedestrian:
    """Somebody in both futures; ahead and left are in the vehicle's frame."""

    id: int
    ahead_m: float
    left_m: float
    distance_m: float  # from the vehicle's outline; 0 within
    fallback: bool
    driven_on: Entry
    supposed: Entry

    @property
    def concerned(self) -> bool:
        """Whether it enters the corridor of either future with any probability worth telling."""
        return max(self.driven_on.probability, self.supposed.probability) >= LIKELY


# --- hypotheses ------------------------------------------------------------------------------------------------------


def braking(deceleration_mps2: float) -> Hypothesis:
    """Returns the hypothesis that the vehicle brakes on its course, evenly, and then stands."""
    return Hypothesis(
        "brakes",
        {"kind": "brake", "deceleration_mps2": deceleration_mps2},
        lambda motion, times_s: vehicle_path.brake(motion, times_s, deceleration_mps2),
    )


def swerving(left: bool, offset_m: float, over_s: float) -> Hypothesis:
    """Returns the hypothesis that the vehicle shifts to one side of its course without slowing down."""
    side, sign = ("left", 1) if left else ("right", -1)
    return Hypothesis(
        f"swerves {side}",
        {"kind": f"swerve {side}", "offset_m": offset_m, "over_s": over_s},
        lambda motion, times_s: vehicle_path.swerve(motion, times_s, sign * offset_m, over_s),
    )


def following(path: Path) -> Hypothesis:
    """Returns the hypothesis that the vehicle drives along a path in a CSV file; raises WhatIfError.

    The file has the columns t, x, y and, if wanted, yaw: seconds from now, from 0 on, metres ahead and to the left of
    where the vehicle is now, and radians to the left. Without a yaw the vehicle points where it drives.
    """
    times_s, poses = read_path(path)
    return Hypothesis(
        f"follows {path.name}",
        {"kind": "path", "file": path.name},
        lambda motion, _: replace(vehicle_path.drive_on(motion, times_s), poses=_from_vehicle(motion, poses)),
    )


def read_path(path: Path) -> tuple[FloatArray, FloatArray]:
    """Reads times (S,) and poses (S, 3) from a CSV file, as `following` describes it; raises WhatIfError."""
    try:
        with path.open(newline="", encoding="utf-8-sig") as stream:
            reader = csv.reader(stream)
            rows = [(reader.line_num, row) for row in reader if row]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise WhatIfError(f"{path} cannot be read: {getattr(error, 'strerror', None) or error}") from error
    header = tuple(word.strip() for word in rows[0][1]) if rows else ()
    if header not in (COLUMNS, COLUMNS[:3]):
        raise WhatIfError(f"{path} must begin with the line t,x,y or t,x,y,yaw; it begins with {','.join(header)!r}")
    values = []
    for line, row in rows[1:]:
        try:
            values.append([float(word) for word in row])
        except ValueError:
            values.append([math.nan])
        if len(values[-1]) != len(header) or not all(abs(value) <= LARGEST for value in values[-1]):  # NaN fails, too
            raise WhatIfError(f"{path}: line {line} should hold {len(header)} numbers, and is {','.join(row)!r}")
    if not values:
        raise WhatIfError(f"{path} has no poses")
    table = np.array(values)
    times_s, places = table[:, 0], table[:, 1:3]
    if times_s[0] != 0 or (np.diff(times_s) <= 0).any():
        raise WhatIfError(f"{path}: t must begin with 0 and rise from row to row")
    yaws = table[:, 3] if len(header) > 3 else _yaws_of(places)
    return times_s, np.column_stack([places, yaws])


def _yaws_of(places_m: FloatArray) -> FloatArray:
    """(S, 2) -> (S,): where each stretch leads; what does not move points as before, at first ahead."""
    moved = np.diff(places_m, axis=0)
    yaws = np.zeros(len(places_m))
    for i, (dx, dy) in enumerate(moved.tolist()):
        yaws[i + 1] = math.atan2(dy, dx) if math.hypot(dx, dy) > 1e-6 else yaws[i]
    return np.unwrap(yaws)


def _from_vehicle(motion: Motion, poses: FloatArray) -> FloatArray:
    """(S, 3) in the vehicle's present frame -> (S, 3) in the odometry frame."""
    c, s = math.cos(motion.yaw_rad), math.sin(motion.yaw_rad)
    x, y, yaw = poses.T
    return np.column_stack([motion.x_m + c * x - s * y, motion.y_m + s * x + c * y, yaw + motion.yaw_rad])


# --- both futures ----------------------------------------------------------------------------------------------------


def frame_at(run: Replay, at_s: float) -> FrameResult:
    """Replays to a moment, in seconds into the log, and returns the frame nearest it; raises LogError if none is near.

    The whole run is used up, so that the run's predictor has nothing left to answer.
    """
    nearest, nearest_s = None, math.inf
    for result in run:
        apart_s = abs((result.log_time_ns - run.reader.start_ns) / 1e9 - at_s)
        if apart_s < nearest_s:
            nearest, nearest_s = result, apart_s
    if nearest is None or nearest_s > NEAREST_S:
        raise LogError(f"there is no frame within {NEAREST_S:g} s of {at_s:g} s into the log")
    return nearest


def what_if(predict: Predict, tracks: TrackFrame, hypothesis: Hypothesis) -> WhatIf:
    """Returns both futures of a frame; raises WhatIfError if the vehicle is not known or cannot do what is supposed."""
    motion = motion_at(tracks.vehicle_history, tracks.stamp_ns)
    driven_on = predict(replace(tracks, vehicle_path=None))
    if motion is None or driven_on.vehicle_path is None:
        raise WhatIfError("the vehicle's motion at this moment is not known, so there is nothing to suppose of it")
    horizon_s = float(driven_on.vehicle_path.times_s[-1])
    times_s = np.append(np.arange(0, horizon_s - STEP_S / 2, STEP_S), horizon_s)
    try:
        path = hypothesis.path(motion, times_s)
    except ManoeuvreError as error:
        raise WhatIfError(str(error)) from error
    supposed = predict(replace(tracks, vehicle_path=path))
    futures = Future("drives on", driven_on.vehicle_path, driven_on), Future(hypothesis.name, path, supposed)
    return WhatIf(tracks, motion, horizon_s, *futures)


def compare(found: WhatIf) -> list[Pedestrian]:
    """Returns everybody's figures in both futures, the most concerned first, then the nearest."""
    c, s = math.cos(found.motion.yaw_rad), math.sin(found.motion.yaw_rad)
    people = []
    answers = zip(
        found.tracks.tracks, found.driven_on.answer.predictions, found.supposed.answer.predictions, strict=True
    )
    for track, driven_on, supposed in answers:
        x, y = track.state[0] - found.motion.x_m, track.state[1] - found.motion.y_m
        ahead, left = float(c * x + s * y), float(c * y - s * x)
        beyond = max(-vehicle_path.REAR_M - ahead, ahead - vehicle_path.FRONT_M, 0.0)
        distance = math.hypot(beyond, max(abs(left) - vehicle_path.WIDTH_M / 2, 0.0))
        entries = _entry(driven_on), _entry(supposed)
        people.append(Pedestrian(track.id, ahead, left, distance, driven_on.fallback, *entries))
    return sorted(people, key=lambda p: (-max(p.driven_on.probability, p.supposed.probability), p.distance_m))


def _entry(prediction: Prediction) -> Entry:
    return Entry(prediction.corridor_probability, prediction.corridor_time_s)


def as_json(found: WhatIf, people: Sequence[Pedestrian]) -> dict[str, Any]:
    """Returns both futures under the names that `--json` writes."""
    return {
        "stamp_ns": found.tracks.stamp_ns,
        "frame_id": found.tracks.frame_id,
        "model": found.driven_on.answer.model,
        "horizon_s": round(found.horizon_s, 3),
        "vehicle": {
            "x_m": round(found.motion.x_m, 4),
            "y_m": round(found.motion.y_m, 4),
            "yaw_rad": round(found.motion.yaw_rad, 5),
            "speed_mps": round(found.motion.speed_mps, 4),
            "yaw_rate_radps": round(found.motion.yaw_rate_radps, 5),
        },
        "paths": {"driven_on": _path_as_json(found.driven_on.path), "supposed": _path_as_json(found.supposed.path)},
        "pedestrians": [
            {
                "id": person.id,
                "ahead_m": round(person.ahead_m, 3),
                "left_m": round(person.left_m, 3),
                "distance_m": round(person.distance_m, 3),
                "fallback": person.fallback,
                "driven_on": _entry_as_json(person.driven_on),
                "supposed": _entry_as_json(person.supposed),
            }
            for person in people
        ],
    }


def _path_as_json(path: VehiclePath) -> dict[str, list[float]]:
    columns = np.column_stack([path.times_s, path.poses]).round(4)
    return dict(zip(COLUMNS, columns.T.tolist(), strict=True))


def _entry_as_json(entry: Entry) -> dict[str, float | None]:
    return {
        "probability": round(entry.probability, 4),
        "time_s": None if entry.time_s is None else round(entry.time_s, 3),
    }


# --- a predictor on the bus ------------------------------------------------------------------------------------------


def ask_what_if(
    session: zenoh.Session, frame: TrackFrame, namespace: str = "", timeout_s: float = 10.0
) -> PredictionFrame:
    """Asks a running predictor (`pcgan predict`) for a frame's answer, its supposed vehicle path included.

    Waits until there is one, and for its answer, `timeout_s` altogether. Raises PredictorError if nobody answers, and
    with the predictor's own words if it refuses the frame.
    """
    key, payload = what_if_key(namespace), codec.encode(frame)
    encoding = ENCODING.with_schema(codec.schema_name(TrackFrame))
    deadline = time.monotonic() + timeout_s
    while (left_s := deadline - time.monotonic()) > 0:
        for reply in session.get(key, payload=payload, encoding=encoding, timeout=left_s):
            if reply.err is not None and time.monotonic() < deadline:  # later it is zenoh's own "Timeout"
                words = reply.err.payload.to_bytes().decode(errors="replace")
                raise PredictorError(f"the predictor on {key} refused the frame: {words}")
            if reply.ok is not None:
                return _answer_of(reply.ok.payload.to_bytes(), frame, key)
        time.sleep(min(RETRY_S, max(deadline - time.monotonic(), 0)))  # without a queryable `get` ends at once
    raise PredictorError(f"no predictor answered on {key} within {timeout_s:g} s; start one with: pcgan predict")


def _answer_of(payload: bytes, frame: TrackFrame, key: str) -> PredictionFrame:
    try:
        answer = codec.decode(PredictionFrame, payload)
    except CodecError as error:
        raise PredictorError(f"what answered on {key} is no prediction: {error}") from error
    if (answer.sequence, answer.stamp_ns) != (frame.sequence, frame.stamp_ns):
        raise PredictorError(f"the predictor on {key} answered another frame: {answer.sequence}, not {frame.sequence}")
    if [prediction.track_id for prediction in answer.predictions] != [track.id for track in frame.tracks]:
        raise PredictorError(f"the predictor on {key} did not answer for the frame's tracks, one by one")
    return answer
