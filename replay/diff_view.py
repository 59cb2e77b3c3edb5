"""Two logs over each other in rerun, seen from above: what is where in which, and lines between what lies apart.

a/tracks, b/tracks     people of each log: discs of the first, outlines of the second
a/paths, b/paths       their likely paths
apart/places           from a track of the first log to the same one of the second, where they lie apart
apart/paths            likewise from step to step of the likeliest path
apart/alone            tracks that only one log has
figures/...            largest distances of each frame, over time
"""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from google.protobuf.message import DecodeError

from replay import colours
from replay.diff_pairs import Pair
from replay.diff_result import Tolerances
from replay.diff_tracks import PREDICTIONS, TRACKS, TrackMap
from replay.drawing import PERSON_RADIUS_M, vehicle_outline
from replay.logged_message import RawMessage
from replay.rerun_view import FAR_FROM_ORIGIN_M, RerunView
from schemas import pcgan_v1_pb2 as pb
from schemas.messages import FloatArray

if TYPE_CHECKING:
    import rerun.blueprint as rrb

COLOURS = {"a": (86, 180, 233), "b": (240, 163, 30)}
APART = (255, 255, 255)
ALONE = (255, 90, 150)
FIGURES = {"figures/tracks": ("tracks apart, m", COLOURS["b"]), "figures/paths": ("likeliest paths apart, m", APART)}
DISC_M = 0.1  # height of a person: higher ones lean outwards
LEAST_MARK_M = 0.01  # shorter lines could not be seen as lines
FARTHEST_M = 1e9  # what lies beyond, or nowhere, is not drawn; the comparison tells of it
LARGEST = 2**63 - 1  # stamp or sequence that rerun takes
LEGEND = """
**Blue discs, wide lines**: the first log, {a}.

**Orange outlines, thin lines**: the second, {b}.

**White**: from a place of the first to the same of the second, where they lie more than {mark:g} m apart.

**Pink**: a track that only one of them has.
"""


class _Person(NamedTuple):
    """A track of one log at one frame."""

    number: int
    place_m: FloatArray  # (2,)


class DiffView(RerunView):
    """Draws both logs' tracks and predictions into a rerun recording."""

    @classmethod
    def of_logs(cls, rrd: Path, a: Path, b: Path, tolerances: Tolerances) -> "DiffView":
        """Returns a view of two logs that writes an .rrd file; raises ViewError if that cannot be made."""
        view = cls.to_file(rrd, f"{a.stem} and {b.stem}")
        assert isinstance(view, cls)
        view._begin(a.name, b.name, tolerances)
        return view

    def _begin(self, a: str, b: str, tolerances: Tolerances) -> None:
        """Lays the view out; `a` and `b` are what the logs are called."""
        import rerun as rr

        recording = self._recording
        assert recording is not None, "a view is drawn into before it is closed"
        self._mark_m = max(tolerances.atol, LEAST_MARK_M)
        self._tracks: dict[str, dict[Any, _Person]] = {"a": {}, "b": {}}
        recording.send_blueprint(_layout())
        legend = LEGEND.format(a=f"`{a}`", b=f"`{b}`", mark=self._mark_m)
        recording.log("legend", rr.TextDocument(legend, media_type="text/markdown"), static=True)
        solid, outline = rr.components.FillMode.Solid, rr.components.FillMode.MajorWireframe
        recording.log("a/tracks", rr.Cylinders3D.from_fields(fill_mode=solid), static=True)
        for entity in ("b/tracks", "apart/alone"):
            recording.log(entity, rr.Cylinders3D.from_fields(fill_mode=outline, line_radii=-1.2), static=True)
        for entity, (name, colour) in FIGURES.items():
            recording.log(entity, rr.SeriesLines(names=name, colors=colour, widths=1.5), static=True)

    def show_pair(self, pair: Pair, track_map: TrackMap | None) -> None:
        """Draws two messages of one time, if they are tracks or predictions."""
        try:
            if _is(pair, TRACKS):
                a, b = (_parsed(pb.TrackFrame, message) for message in (pair.a, pair.b))
                self._show_tracks(a, b, track_map)
            elif _is(pair, PREDICTIONS):
                a, b = (_parsed(pb.PredictionFrame, message) for message in (pair.a, pair.b))
                self._show_predictions(a, b, pair.log_time_ns, track_map)
        except DecodeError:
            return  # the comparison has told of it

    def _show_tracks(self, a: Any, b: Any, track_map: TrackMap | None) -> None:
        import rerun as rr

        frame = a if a is not None else b
        found = {
            name: {
                _key(track_map, log, each.epoch, track.id): _Person(track.id, np.array([track.x, track.y]))
                for track in each.tracks
                if _drawable([track.x, track.y])
            }
            if each is not None
            else {}
            for log, (name, each) in enumerate((("a", a), ("b", b)))
        }
        self._tracks = found
        self._centre(frame, b)
        for name, people in found.items():
            places = np.array([person.place_m for person in people.values()]).reshape(-1, 2)
            count, is_a = len(people), name == "a"
            self._columns.add(
                f"{name}/tracks",
                rr.Cylinders3D,
                centers=self._at(places, DISC_M / 2 if is_a else DISC_M),
                lengths=[DISC_M] * count,
                radii=[PERSON_RADIUS_M * (0.85 if is_a else 1.1)] * count,
                colors=[COLOURS[name]] * count,
                labels=[_label(key, person, found) for key, person in people.items()],
            )
        both = found["a"].keys() & found["b"].keys()
        ends = np.array([[found["a"][key].place_m, found["b"][key].place_m] for key in sorted(both)]).reshape(-1, 2, 2)
        self._lines("apart/places", "figures/tracks", ends)
        alone = [
            person.place_m
            for name, other in (("a", "b"), ("b", "a"))
            for key, person in found[name].items()
            if key not in found[other]
        ]
        self._columns.add(
            "apart/alone",
            rr.Cylinders3D,
            centers=self._at(np.array(alone).reshape(-1, 2), DISC_M),
            lengths=[2 * DISC_M] * len(alone),
            radii=[1.6 * PERSON_RADIUS_M] * len(alone),
            colors=[ALONE] * len(alone),
        )
        self._end(frame)

    def _show_predictions(self, a: Any, b: Any, log_time_ns: int, track_map: TrackMap | None) -> None:
        import rerun as rr

        from replay.rerun_columns import Strips

        frame = a if a is not None else b
        if self._origin_m is None:  # the logs have no tracks
            self._centre_on(np.array([_points(each)[0][0] for each in frame.predictions if _points(each)]))
        likeliest: dict[str, dict[Any, FloatArray]] = {"a": {}, "b": {}}
        for log, (name, each) in enumerate((("a", a), ("b", b))):
            strips, opacities = [], []
            for prediction in each.predictions if each is not None else ():
                epoch = track_map.epoch(log, log_time_ns, each.sequence) if track_map is not None else 0
                key = _key(track_map, log, epoch, prediction.track_id)
                start = [self._tracks[name][key].place_m[None]] if key in self._tracks[name] else []
                points = _points(prediction)
                likeliest[name].update({key: points[0]} if points else {})
                strips += [np.concatenate([*start, path]) for path in points]
                shares = [path.probability for path in prediction.paths[: len(points)]]
                opacities += [share if math.isfinite(share) else 0.0 for share in shares]
            flat = np.concatenate([np.zeros((0, 2)), *strips])
            self._columns.add(
                f"{name}/paths",
                rr.LineStrips3D,
                strips=Strips(
                    self._at(flat, 0.02 if name == "a" else 0.04), np.array([len(strip) for strip in strips], np.int64)
                ),
                colors=colours.with_opacity(
                    np.tile(np.array(COLOURS[name], np.uint8), (len(strips), 1)), colours.path_opacity(opacities)
                ),
                radii=np.full(len(strips), -2.0 if name == "a" else -0.7, np.float32),
            )
        ends = [
            np.stack([likeliest["a"][key], likeliest["b"][key]], axis=1)
            for key in sorted(likeliest["a"].keys() & likeliest["b"].keys())
            if len(likeliest["a"][key]) == len(likeliest["b"][key])
        ]
        self._lines("apart/paths", "figures/paths", np.concatenate([np.zeros((0, 2, 2)), *ends]))
        self._end(frame)

    def _lines(self, entity: str, figure: str, ends_m: FloatArray) -> None:
        """Draws lines (N, 2, 2) where their ends lie apart, and the longest as a figure."""
        import rerun as rr

        from replay.rerun_columns import Strips

        apart = np.hypot(*(ends_m[:, 0] - ends_m[:, 1]).T)
        drawn = ends_m[apart > self._mark_m]
        points = self._at(drawn.reshape(-1, 2), 2 * DISC_M)
        count = len(drawn)
        self._columns.add(
            entity,
            rr.LineStrips3D,
            strips=Strips(points, np.full(count, 2)),
            colors=np.tile(np.array(APART, np.uint8), (count, 1)),
            radii=np.full(count, -1.3, np.float32),
        )
        self._columns.add(figure, rr.Scalars, scalars=np.array([apart.max(initial=0.0)]))

    def _centre(self, frame: Any, other: Any) -> None:
        """Moves the view's middle to the vehicle, or to everybody's middle where the logs do not say where that is."""
        for each in (frame, other):
            past = each.vehicle_history if each is not None else None
            pose = [*past.x[-1:], *past.y[-1:], *past.yaw[-1:]] if past is not None else []
            if len(pose) == 3 and _drawable(pose):
                self._centre_on(np.array([pose[:2]]))
                self._show_vehicle(*pose)
                return
        people = [person.place_m for part in self._tracks.values() for person in part.values()]
        self._centre_on(np.array(people).reshape(-1, 2))

    def _centre_on(self, places_m: FloatArray) -> None:
        import rerun as rr

        if len(places_m) == 0:
            return
        middle = places_m.mean(axis=0)
        if self._origin_m is None:
            self._origin_m = np.append(middle.round() if abs(middle).max() > FAR_FROM_ORIGIN_M else middle * 0, 0.0)
        self._columns.add("map/centre", rr.Transform3D, translation=self._at(middle[None], 0.0))

    def _show_vehicle(self, x: float, y: float, yaw: float) -> None:
        import rerun as rr

        from replay.rerun_columns import Strips

        map_from_vehicle = np.eye(4)
        map_from_vehicle[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
        map_from_vehicle[:2, 3] = x, y
        outline = vehicle_outline(map_from_vehicle)
        self._columns.add(
            "map/vehicle",
            rr.LineStrips3D,
            strips=Strips(self._at(outline, 0.02), np.array([len(outline)])),
            colors=[colours.VEHICLE],
            radii=np.array([-0.8], np.float32),
        )

    def _at(self, places_m: FloatArray, height_m: float) -> FloatArray:
        """Returns places (N, 2) as rerun takes them: (N, 3), less the origin, single precision."""
        origin = self._origin_m[:2] if self._origin_m is not None else np.zeros(2)
        return np.column_stack([places_m - origin, np.full(len(places_m), height_m)]).astype(np.float32)

    def _end(self, frame: Any) -> None:
        self._columns.end_frame(max(frame.stamp_ns, -LARGEST), min(frame.sequence, LARGEST))


def _is(pair: Pair, name: str) -> bool:
    messages = [message for message in (pair.a, pair.b) if message is not None]
    return all(message.schema.name == name and message.encoding == "protobuf" for message in messages)


def _parsed(kind: Any, message: RawMessage | None) -> Any:
    return None if message is None else kind.FromString(message.data)


def _drawable(values: Iterable[float]) -> bool:
    return all(abs(value) < FARTHEST_M for value in values)  # False of NaN


def _points(prediction: Any) -> list[FloatArray]:
    """Returns a prediction's paths, the likeliest first; none if any of them makes no sense."""
    paths = prediction.paths
    if not all(path.x and len(path.x) == len(path.y) and _drawable([*path.x, *path.y]) for path in paths):
        return []
    return [np.column_stack([path.x, path.y]) for path in paths]


def _key(track_map: TrackMap | None, log: int, epoch: int, number: int) -> Any:
    return (1, (epoch, number)) if track_map is None else track_map.key(log, (epoch, number))


def _label(key: Any, person: _Person, found: dict[str, dict[Any, _Person]]) -> str:
    numbers = [found[name][key].number if key in found[name] else None for name in ("a", "b")]
    if None in numbers or numbers[0] == numbers[1]:
        return str(person.number)
    return f"{numbers[0]} = {numbers[1]}"


def _layout() -> "rrb.Blueprint":
    """Returns the blueprint: both logs from above around the vehicle, how far they are apart, what the colours mean."""
    import rerun.blueprint as rrb

    from replay.rerun_layout import map_view

    seen = map_view(["/map/**", "/a/**", "/b/**", "/apart/**"], "Both logs")
    figures = rrb.TimeSeriesView(
        origin="/figures",
        name="Largest distance of each frame",
        plot_legend=rrb.PlotLegend(corner=rrb.Corner2D.LeftTop),
    )
    legend = rrb.TextDocumentView(origin="/legend", name="Legend")
    return rrb.Blueprint(
        rrb.Horizontal(seen, rrb.Vertical(figures, legend), column_shares=[3, 1]),
        rrb.TimePanel(timeline="stamp", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )
