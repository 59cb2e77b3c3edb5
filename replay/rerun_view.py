"""Frame results shown in rerun, in a file or in a viewer of its own; `NullView` shows nothing.

rerun-sdk is an optional dependency: it is imported when a `RerunView` is made, not before.
"""

import io
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext, suppress
from pathlib import Path
from types import TracebackType
from typing import IO, TYPE_CHECKING, Protocol, Self

import numpy as np

from replay.errors import ReplayError
from replay.frame_result import FrameResult
from replay.image_size import image_size_px
from replay.part_file import open_part, part_of
from schemas.messages import FloatArray

if TYPE_CHECKING:
    import rerun as rr

    from replay.rerun_viewer import Viewer

APPLICATION = "pcgan"
FRAMES_PER_BATCH = 50  # sent at once
VIEWER_PATIENCE_S = 0.05  # a viewer gets what there is after this: in real time, every frame as it comes
_END, _END_BYTES = b"RRF2FOOT", 64  # what the last bytes of an .rrd file hold
FAR_FROM_ORIGIN_M = 10_000.0  # rerun draws in single precision: a map farther out is shifted towards its own start


class ViewError(ReplayError):
    """A view that cannot be opened or written."""


class View(Protocol):
    """Something that shows frame results until it is left."""

    def __enter__(self) -> Self: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None: ...

    def show(self, result: FrameResult) -> None:
        """Shows one frame."""


class NullView:
    """Shows nothing, so that nobody has to ask whether there is a view."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Has nothing to close."""

    def show(self, result: FrameResult) -> None:
        """Shows nothing."""


class RerunView:
    """Draws frame results into a rerun recording; leave it, or close it, to complete the recording."""

    def __init__(self, recording: "rr.RecordingStream", path: Path | None = None, patience_s: float = math.inf):
        from replay.rerun_columns import RerunColumns

        self._recording: rr.RecordingStream | None = recording
        self._columns = RerunColumns(recording, FRAMES_PER_BATCH, patience_s)
        self._path = path
        self._claim: IO[bytes] | None = None  # keeps other processes from writing the same part
        self.viewer: Viewer | None = None  # of a spawned view, for whoever wants to end it
        self._origin_m: FloatArray | None = (
            None  # (3,)  what is subtracted from the odometry frame; None before a frame
        )
        self._grid_cell_m: tuple[float, float] | None = None
        self._cameras: dict[str, tuple[int, int]] = {}  # name -> width and height in pixels
        self._image_stamps_ns: dict[str, int] = {}

    @classmethod
    def to_file(cls, path: Path, recording_id: str = "replay") -> "RerunView":
        """Returns a view that writes an .rrd file: `path` with `.part` behind it, renamed once it is complete.

        Two runs with one `recording_id` (take what names the input, such as its checksum) give recordings that
        `rerun rrd compare --unordered` finds equal. Raises ViewError if the file cannot be made, OutputError if another
        process is writing it.
        """
        with _rerun_quiet():
            recording = _new_recording(recording_id)
        part = part_of(path)
        try:
            claim = open_part(path)  # rerun reports a place that cannot be written only later, from another thread
            recording.save(str(part))
        except (OSError, RuntimeError) as error:
            raise ViewError(f"{path} cannot be written: {getattr(error, 'strerror', None) or error}") from error
        view = cls(recording, path)
        view._claim = claim
        return view

    @classmethod
    def spawn(cls, recording_id: str = "replay", *, headless: bool = False) -> "RerunView":
        """Returns a view in a new viewer, which listens on loopback only and stays open after the replay.

        Raises ViewError if rerun is missing or its viewer does not start, as on a machine without a screen.
        """
        recording = _new_recording(recording_id)
        from replay.rerun_viewer import ViewerError, start_viewer

        try:
            viewer = start_viewer(headless=headless)
        except ViewerError as error:
            raise ViewError(str(error)) from error
        recording.connect_grpc(viewer.url)
        view = cls(recording, patience_s=VIEWER_PATIENCE_S)
        view.viewer = viewer
        return view

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if error is None:
            self.close()
        else:
            with suppress(ViewError):  # what went wrong first is what has to be told
                self.close(complete=False)

    def close(self, *, complete: bool = True) -> None:
        """Sends what is waiting and ends the recording; a file gets its final name only if `complete`.

        Raises ViewError if the file could not be written to its end. Closing twice does nothing.
        """
        if self._recording is None:
            return
        recording, self._recording = self._recording, None
        try:
            with nullcontext() if complete else suppress(IndexError, ValueError):  # it may end in the middle of a row
                self._columns.flush()
            recording.flush()
            recording.disconnect()
            if self._path is not None and complete:
                _require_whole(part_of(self._path))
                part_of(self._path).replace(self._path)
        except (OSError, RuntimeError, ValueError) as error:
            raise ViewError(f"the rerun recording could not be completed: {error}") from error
        finally:
            if self._claim is not None:
                self._claim.close()

    def show(self, result: FrameResult) -> None:
        """Draws one frame; it is found under its stamp and its sequence."""
        self._draw(result)
        self._columns.end_frame(result.tracks.stamp_ns, result.tracks.sequence)

    def _draw(self, result: FrameResult) -> None:
        """Draws all that a frame has, and leaves its rows open for more."""
        from replay import rerun_drawing as drawing
        from replay.rerun_layout import layout

        if self._recording is None:
            raise ValueError("this view is closed; make a new one")
        seen = {c.name: (c.model.width_px, c.model.height_px) for c in result.sensors.cameras}
        new = sorted(seen.keys() - self._cameras.keys())
        if self._origin_m is None or new:
            self._cameras |= seen
            for name in new:
                drawing.log_camera(self._recording, name, seen[name])
            self._recording.send_blueprint(layout(self._cameras))
        if self._origin_m is None:
            position = result.sensors.map_from_vehicle[:3, 3]
            self._origin_m = position.round() if abs(position).max() > FAR_FROM_ORIGIN_M else position * 0
            drawing.log_static(self._recording)
        cell_m = drawing.grid_cell(result, self._origin_m)
        if cell_m != self._grid_cell_m:
            self._grid_cell_m = cell_m
            drawing.draw_grid(self._columns, cell_m)
        drawing.draw_map(self._columns, result, self._origin_m)
        drawing.draw_people(self._columns, result, self._origin_m)
        drawing.draw_predictions(self._columns, result, self._origin_m)
        drawing.draw_cameras(self._columns, result, tuple(self._cameras))
        drawing.draw_counts(self._columns, result)
        self._log_images(result)

    def _log_images(self, result: FrameResult) -> None:
        """Logs images one by one, encoded as they are, scaled to the calibration; none is logged twice."""
        import rerun as rr

        assert self._recording is not None
        self._recording.set_time("stamp", timestamp=np.datetime64(result.tracks.stamp_ns, "ns"))
        self._recording.set_time("frame", sequence=result.tracks.sequence)
        for name, image in sorted(result.images.items()):
            if self._image_stamps_ns.get(name) == image.stamp_ns:
                continue
            self._image_stamps_ns[name] = image.stamp_ns
            picture = rr.EncodedImage(contents=image.data, media_type=_media_type(image.format))
            own, wanted = image_size_px(image.data), self._cameras.get(name)
            scale = (wanted[0] / own[0], wanted[1] / own[1], 1.0) if own and wanted and all(own) else (1.0, 1.0, 1.0)
            self._recording.log(f"cameras/{name}/image", picture, rr.Transform3D(scale=scale))


def _media_type(image_format: str) -> str:
    """Returns "image/jpeg" for what logs call jpeg, jpg or "bgr8; jpeg compressed bgr8"."""
    words = image_format.lower().replace(";", " ").split()
    known = [word for word in words if word in ("png", "webp", "avif")]
    return f"image/{known[0]}" if known else "image/jpeg"


def _require_whole(part: Path) -> None:
    """Raises OSError unless a recording has its end: if that alone did not fit on the disk, rerun only logs it."""
    with part.open("rb") as stream:
        stream.seek(-min(_END_BYTES, part.stat().st_size), io.SEEK_END)
        if _END not in stream.read():
            raise OSError(f"{part} lacks its end; is the disk full?")


@contextmanager
def _rerun_quiet() -> Iterator[None]:
    """Has rerun log nothing, if it starts in the block: of a full disk it logs several lines, where we say one.

    The variable must not stay: zenoh, here and in processes that are started later, goes by it, too.
    """
    chosen = os.environ.get("RUST_LOG")
    os.environ["RUST_LOG"] = chosen or "off"
    try:
        yield
    finally:
        if chosen is None:
            del os.environ["RUST_LOG"]


def _new_recording(recording_id: str) -> "rr.RecordingStream":
    """Returns a recording without the wall clock's timelines, so that two runs are equal."""
    try:
        import rerun as rr
    except ImportError as error:
        raise ViewError('the view needs rerun-sdk, which is not installed: pip install "pcgan[view]"') from error
    recording = rr.RecordingStream(APPLICATION, recording_id=recording_id, send_properties=False)
    recording.set_log_time_enabled(False)
    recording.set_log_tick_enabled(False)
    return recording
