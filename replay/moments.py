"""The worst moments of a replay: where predictions were most wrong, who was missed, whose track changed.

Works while frames stream by, as the score does. What it keeps does not grow with the log: the frames of the last few
seconds, sums, and the worst candidates of each kind and slice with the frame that their picture is drawn from.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from replay.check_result import ErrorSlice, Moment
from replay.errors import OutputError
from replay.frame_result import FrameResult
from replay.moment_errors import ErrorWatch
from replay.moment_people import PeopleWatch
from replay.moment_ranking import Candidate

MOST = 10  # moments of each kind
FEW = 3  # of each kind within each slice


class Moments:
    """Takes frame results in order; `finish` at the end.

    Prediction errors are those of the likeliest path against where the person was: in the ground truth if the log has
    one, else where its own track was measured later. Missed people and id switches need the ground truth.

    Kept are the `most` worst of each kind, and the `few` worst within each slice: prediction errors by range, nearness,
    turning, speed and, ranked by the error at that step, horizon; missed people and id switches by range and nearness.

    `log_start_ns` is the log's first log time, from which a moment's seconds count; without it the first frame's.
    """

    def __init__(self, log_start_ns: int | None = None, most: int = MOST, few: int = FEW):
        self._log_start_ns = log_start_ns
        self._errors, self._people = ErrorWatch(most, few), PeopleWatch(most, few)
        self._epoch = 0

    def add(self, result: FrameResult) -> None:
        """Takes the next frame."""
        if self._log_start_ns is None:
            self._log_start_ns = result.log_time_ns
        if result.images:
            result = replace(result, images={})  # what is kept of a frame goes without
        if result.tracks.epoch != self._epoch:
            self._end_epoch()
            self._epoch = result.tracks.epoch
        self._errors.add(result)
        self._people.add(result)

    def finish(self, pictures: Path | None = None) -> tuple[list[Moment], list[ErrorSlice]]:
        """Returns the worst moments, worst first within each kind, and the prediction errors in slices.

        With a folder each moment's picture is drawn there, if matplotlib is installed: `Moment.picture` tells. Raises
        OutputError if the folder cannot be written.
        """
        self._end_epoch()
        found = [*self._errors.ranked(), *self._people.ranked()]
        moments = [self._moment(candidate) for candidate in found]
        if pictures is not None:
            moments = _with_pictures(moments, found, pictures)
        return moments, self._errors.slices()

    def _end_epoch(self) -> None:
        self._errors.end_epoch()
        self._people.end_epoch()

    def _moment(self, candidate: Candidate) -> Moment:
        result = candidate.result
        pose = result.sensors.map_from_vehicle
        offset_m = candidate.place_m - pose[:2, 3]
        ahead_m, left_m = (offset_m @ pose[:2, :2]).tolist()
        return Moment(
            kind=candidate.kind,
            at_s=(result.log_time_ns - (self._log_start_ns or 0)) / 1e9,
            stamp_ns=candidate.stamp_ns,
            size=candidate.size,
            text=candidate.text,
            track_id=candidate.track_ids[-1] if candidate.track_ids else 0,
            person_id=candidate.person_id,
            ahead_m=ahead_m,
            left_m=left_m,
            range_m=float(np.hypot(*offset_m)),
            speed_mps=float(np.hypot(*candidate.velocity_mps)),
            turning=candidate.turning,
            near_vehicle=candidate.near_vehicle,
            horizon_errors_m=candidate.horizon_errors_m,
            worst_of=candidate.worst_of,
        )


def _with_pictures(moments: Sequence[Moment], candidates: Sequence[Candidate], folder: Path) -> list[Moment]:
    """Draws a picture of each moment; returns the moments as they are where matplotlib is missing."""
    from replay.moment_picture import draw_moment
    from replay.picture import NoMatplotlib

    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"the pictures' folder {folder} cannot be made: {error.strerror or error}") from error
    drawn, numbers = [], dict.fromkeys((moment.kind for moment in moments), 0)
    try:
        for moment, candidate in zip(moments, candidates, strict=True):
            numbers[moment.kind] += 1
            path = folder / f"{moment.kind.name.lower()}-{numbers[moment.kind]:02d}.png"
            draw_moment(candidate, path)
            drawn.append(replace(moment, picture=path))
    except NoMatplotlib:
        return list(moments)
    return drawn
