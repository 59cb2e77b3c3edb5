"""Log replay: MCAP in, tracks over zenoh to the predictor, MCAP and rerun out.

Importing this package loads nothing else: what it exports is loaded when it is first asked for. The pytest plugin lies
in here, and pytest imports it in every run of everybody who has us installed.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from replay.errors import LogError, OutputError, PredictorError, ReplayError
    from replay.frame_result import FrameResult
    from replay.record import Summary, record
    from replay.replay_cache import replay_log
    from replay.replayed import Replayed
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
    "Replayed",
    "Summary",
    "record",
    "replay",
    "replay_log",
]

_HOME = {
    "FrameResult": "frame_result",
    "LogError": "errors",
    "OutputError": "errors",
    "PredictorChoice": "session",
    "PredictorError": "errors",
    "Replay": "session",
    "ReplayError": "errors",
    "ReplaySettings": "session",
    "Replayed": "replayed",
    "Summary": "record",
    "record": "record",
    "replay": "session",
    "replay_log": "replay_cache",
}


class _Package(ModuleType):
    """This package: a name of `__all__` is looked up in its module on first use.

    A class, not a module's `__getattr__`, for two reasons. Importing the module replay.record sets the attribute
    `record` of its package: here the function of that name stays what users get, in whatever order things are
    imported. And type checkers still report names that do not exist.
    """

    def __getattr__(self, name: str) -> object:
        if name not in _HOME:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        value = getattr(import_module(f"{self.__name__}.{_HOME[name]}"), name)
        setattr(self, name, value)
        return value

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *__all__})


sys.modules[__name__].__class__ = _Package
