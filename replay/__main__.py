"""The command `pcgan`, as `python -m replay` too: quiet, from the first moment to the last, when Ctrl-C is pressed."""

import os
import signal
from types import FrameType


def main() -> None:
    """Runs the command.

    Importing it takes most of a second, and leaving Python some more. A Ctrl-C then ends the process at once with exit
    code 130; by itself Python would print a traceback. In between the command sees to it.
    """
    heard = signal.getsignal(signal.SIGINT) == signal.default_int_handler  # else whoever started us wants it ignored
    if heard:
        signal.signal(signal.SIGINT, _leave)
    from replay.cli import main as run

    if heard:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        run()
    finally:
        if heard:
            signal.signal(signal.SIGINT, _leave)


def _leave(signum: int, frame: FrameType | None) -> None:  # noqa: ARG001  given by signal
    os._exit(128 + signum)  # nothing of ours is open that could be left half written


if __name__ == "__main__":
    main()
