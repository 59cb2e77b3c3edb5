"""USyd-style drives in MCAP, simulated: a crowd or an annotated clip, six cameras, a LiDAR, odometry, ground truth."""

import math
from pathlib import Path

from pcgan.clips import TRAJECTORY_SUFFIXES
from replay.simulator import drive
from replay.simulator.clip_motion import clip_motion
from replay.simulator.drive import DriveSummary, Progress
from replay.simulator.motion import SimulationError
from replay.simulator.social_force import crowd_motion

CROWD_DURATION_S = 60.0

__all__ = ["DriveSummary", "SimulationError", "simulate"]


def simulate(
    output: Path,
    *,
    clip: str | None,
    vehicle: int | None,
    pedestrians: int,
    duration_s: float | None,
    seed: int,
    points: bool = False,
    progress: Progress | None = None,
) -> DriveSummary:
    """Writes a simulated drive; the same arguments give the same bytes.

    Args:
        output: the MCAP file to write; it appears under this name only when complete.
        clip: an annotated clip to drive through ("dut/roundabout_04"), or None for a simulated crowd.
        vehicle: which of the clip's vehicles records; None for the one that moves and is present longest.
        pedestrians: how many people there are around the vehicle; a clip has its own.
        duration_s: how long; None: 60 s of a crowd, or all of a clip. A clip ends when its vehicle leaves.
        seed: of the crowd and of the sensors, 0 or more.
        points: the LiDAR's raw points, too; every other message stays what it is without them.
        progress: called now and then with the fraction done.

    Raises SimulationError saying what to ask for instead; pcgan.clips.DataNotFound where a clip's data set is not on
    this machine; OSError if writing fails.
    """
    if seed < 0:
        raise SimulationError(f"a seed must be 0 or more, got {seed}")
    if duration_s is None and clip is None:
        duration_s = CROWD_DURATION_S
    if duration_s is not None and not (math.isfinite(duration_s) and duration_s > 0):
        raise SimulationError(f"a drive needs a positive duration, got {duration_s} s")
    if clip is None and vehicle is not None:
        raise SimulationError(f"vehicle {vehicle} is one of a clip's; name the clip, too")
    if clip is None:
        assert duration_s is not None
        motion = crowd_motion(pedestrians, duration_s, seed)
        settings: dict[str, object] = {"pedestrians": pedestrians, "duration_s": duration_s}
    else:
        motion = clip_motion(clip, vehicle, seed)
        is_file = clip.endswith(TRAJECTORY_SUFFIXES)
        settings = {"clip": Path(clip).name if is_file else clip, "vehicle": vehicle, "duration_s": duration_s}
    settings["seed"] = seed
    if points:
        settings["points"] = True
    return drive.simulate(
        motion, output, seed, duration_s=duration_s, settings=settings, points=points, progress=progress
    )
