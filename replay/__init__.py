"""Log replay: MCAP in, tracks over zenoh to the predictor, MCAP and rerun out."""

from replay.errors import LogError, OutputError, PredictorError, ReplayError
from replay.frame_result import FrameResult
from replay.record import Summary, record
from replay.session import PredictorChoice, Replay, ReplaySettings, replay

__all__ = [
    "FrameResult",
    "LogError",
    "OutputError",
    "PredictorChoice",
    "PredictorError",
    "Replay",
    "ReplayError",
    "ReplaySettings",
    "Summary",
    "record",
    "replay",
]
