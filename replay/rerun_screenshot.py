"""A picture of a rerun recording without a screen: `python -m replay.rerun_screenshot DRIVE.rrd OUT.png --at 12.5`."""

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from replay.errors import ReplayError
from replay.rerun_viewer import MESA, ViewerError, headless_viewer

WINDOW_PX = (1920, 1080)
LOAD_LIMIT_S = 60.0
SETTLE_S = 8.0  # until the viewer's start-up notes have faded and images are decoded


def take_screenshot(
    recording: Path, picture: Path, at_s: float | None = None, window_px: tuple[int, int] = WINDOW_PX
) -> None:
    """Writes a PNG of a recording as the rerun viewer shows it.

    Args:
        recording: an .rrd file with the timeline "stamp".
        picture: where the PNG goes; a half-written one never stays.
        at_s: seconds after the recording's first frame, cut to its length; in its middle if None.
        window_px: width and height.

    Raises:
        ViewerError: rerun or a graphics driver is missing, or the recording cannot be shown.
    """
    if not recording.is_file():
        raise ViewerError(f"there is no recording {recording}")
    try:
        from rerun.experimental import ViewerClient
    except ImportError as error:
        raise ViewerError('a picture needs rerun-sdk, which is not installed: pip install "pcgan[view]"') from error
    with headless_viewer(window_px) as viewer:
        try:
            client = ViewerClient.connect(viewer.url)
            client.open(str(recording.resolve()))
            start_ns, end_ns = _span_ns(client, recording)
            client.run_command("ui.toggle_top_panel")  # a menu and notes on the driver, of no use in a picture
            offset_ns = (end_ns - start_ns) // 2 if at_s is None else int(at_s * 1e9)
            stamp_ns = min(start_ns + max(offset_ns, 0), end_ns)
            client.set_time("stamp", timestamp=np.datetime64(stamp_ns, "ns"), play_state="paused")
            time.sleep(SETTLE_S)
            png = client.take_screenshot()
        except (RuntimeError, OSError, ValueError) as error:
            raise ViewerError(f"no picture of {recording}: {error}; a driver may be missing: {MESA}") from error
    part = picture.with_name(picture.name + ".part")
    part.write_bytes(png)
    part.replace(picture)


def _span_ns(client: object, recording: Path) -> tuple[int, int]:
    """Waits for the recording to be loaded, and returns its first and last stamp."""
    deadline = time.monotonic() + LOAD_LIMIT_S
    while time.monotonic() < deadline:
        state = client.get_state()  # type: ignore[attr-defined]
        spans = [
            (timeline.start, timeline.end)
            for shown in state.recordings
            for timeline in shown.timelines
            if timeline.name == "stamp"
        ]
        if spans and not state.loading and None not in spans[0]:
            return int(spans[0][0]), int(spans[0][1])
        time.sleep(0.1)
    raise ViewerError(f'{recording} has no timeline "stamp"; it must be a recording of `pcgan replay`')


def main(arguments: Sequence[str] | None = None) -> int:
    """Runs the command; returns its exit code."""
    parser = argparse.ArgumentParser(description="Draws a moment of a rerun recording as a PNG, without a screen.")
    parser.add_argument("recording", type=Path, help="an .rrd file of `pcgan replay`")
    parser.add_argument("picture", type=Path, help="the PNG to write")
    parser.add_argument("--at", type=float, metavar="SECONDS", help="after the first frame; without it, half way")
    parser.add_argument("--size", type=int, nargs=2, default=WINDOW_PX, metavar=("WIDTH", "HEIGHT"), help="in pixels")
    options = parser.parse_args(arguments)
    try:
        take_screenshot(options.recording, options.picture, options.at, tuple(options.size))
    except ReplayError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
