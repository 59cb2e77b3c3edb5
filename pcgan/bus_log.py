"""Whom zenoh turned away, told in one line each.

zenoh 1.10 prints its log on stdout and cannot be told otherwise. It warns of a peer without a good certificate, and
mentions a wrong password only at the debug level. So the process's stdout is read through a pipe: zenoh's lines become
sentences, everything else goes where it was going.
"""

import os
import re
import sys
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import zenoh

FILTER = "error,zenoh_link_tls=warn,zenoh_transport::unicast::establishment::accept=debug"

_COLOUR = re.compile(r"\x1b\[[0-9;]*m")
_LINE = re.compile(r"\d{4}-\d\d-\d\dT\S+Z +(?P<level>[A-Z]+) .*?ThreadId\(\d+\) (?P<target>[\w:]+): (?P<text>.*)")
_WRONG = {
    "Invalid password": "wrong password",
    "Invalid user": "unknown user",
    "Expected extension": "no user and password",
}
_MOST_SENTENCES = 1000
_LONGEST = 200  # zenoh describes its links in structs of several lines' length


def sentence(line: str) -> str | None:
    """Returns what a line of zenoh's log has to say; "" if nothing of interest, None if it is no line of zenoh's."""
    match = _LINE.fullmatch(_COLOUR.sub("", line).rstrip("\n"))
    if match is None:
        return None
    text = match["text"].partition(" at /")[0]  # the place in zenoh's source
    if match["target"].startswith("zenoh_link_tls"):
        return f"refused a peer: {text.partition('. Hint:')[0]}"  # the hint is about open files, whatever went wrong
    if match["target"].endswith("establishment::accept"):
        reason = next((ours for theirs, ours in _WRONG.items() if theirs in text), "")
        return f"refused a peer: {reason}" if reason else ""
    return f"zenoh: {text[:_LONGEST]}" if match["level"] == "ERROR" else ""


@contextmanager
def refusals_told(tell: Callable[[str], None]) -> Iterator[None]:
    """Has `tell` called, from a thread of its own, with a sentence for every peer that zenoh turns away.

    Who is refused tries again every few seconds: the same sentence is told the 1st, 10th, 100th time and so on. With
    RUST_LOG set, zenoh's own log goes to stdout instead, as zenoh writes it. Once per process, before a session opens.
    """
    if os.environ.get("RUST_LOG"):
        zenoh.try_init_log_from_env()  # type: ignore[no-untyped-call]
        yield
        return
    zenoh.init_log_from_env_or(FILTER)
    sys.stdout.flush()
    stdout = os.dup(1)
    reading, writing = os.pipe()
    os.dup2(writing, 1)
    os.close(writing)
    reader = threading.Thread(target=_read, args=(reading, stdout, tell), daemon=True)
    reader.start()
    try:
        yield
    finally:
        sys.stdout.flush()
        os.dup2(stdout, 1)  # closes the pipe's last end, which ends the reader
        reader.join(timeout=5)
        os.close(stdout)


def _read(pipe: int, stdout: int, tell: Callable[[str], None]) -> None:
    times: Counter[str] = Counter()
    with open(pipe, "rb") as lines:
        for line in lines:
            said = sentence(line.decode(errors="replace"))
            if len(times) > _MOST_SENTENCES:  # some hold an address, of which there are many
                times.clear()
            times[said or ""] += 1
            number = str(times[said or ""])
            with suppress(OSError):  # whoever read our output may be gone; the pipe must be emptied all the same
                if said is None:
                    os.write(stdout, line)
                elif said and number.strip("0") == "1":
                    tell(said if number == "1" else f"{said} ({number} times)")
