"""What can go wrong in a replay, and the running count of what was refused."""

from collections import Counter

LONGEST_LINE = 1500  # characters


def one_line(text: str) -> str:
    """Returns a text as a terminal can show it in one line: a recording's names may hold anything, and be endless."""
    if not text.isprintable():
        text = "".join(c if c.isprintable() else c.encode("unicode_escape", "backslashreplace").decode() for c in text)
    return text if len(text) <= LONGEST_LINE else f"{text[: LONGEST_LINE // 2]} ... {text[-LONGEST_LINE // 2 :]}"


class ReplayError(Exception):
    """Anything a user can mend: shown as one line, exit code 2."""

    def __str__(self) -> str:
        return one_line(super().__str__())


class LogError(ReplayError):
    """A recording that cannot be used: unreadable, damaged, or without what a replay needs."""


class OutputError(ReplayError):
    """An output that cannot be written."""


class PredictorError(ReplayError):
    """A predictor that cannot be started, stays silent, or fails again and again."""


class Refusals:
    """Messages that were refused, counted by topic and reason; the run goes on unless `strict`.

    Keeps the first few in words, and a limited number of different reasons (they quote values), so that a summary can
    show them without growing with the log.
    """

    KEPT = 20
    REASONS = 1000

    def __init__(self, *, strict: bool = False):
        self._strict = strict
        self.counts: Counter[tuple[str, str]] = Counter()
        self.first: list[str] = []

    def add(self, topic: str, stamp_ns: int, kind: str, detail: str = "") -> None:
        """Counts one refused message; raises LogError at once if strict."""
        line = one_line(f"{topic} at {stamp_ns / 1e9:.3f} s refused: {kind}{f' ({detail})' if detail else ''}")
        if self._strict:
            raise LogError(f"{line}; without --strict the run would go on")
        if len(self.counts) >= self.REASONS and (topic, kind) not in self.counts:
            kind = "other reasons"
        self.counts[topic, kind] += 1
        if len(self.first) < self.KEPT:
            self.first.append(line)

    @property
    def total(self) -> int:
        """How many messages were refused."""
        return self.counts.total()

    def as_json(self) -> list[dict[str, object]]:
        """Returns one row per topic and reason, sorted."""
        return [{"topic": topic, "reason": kind, "count": n} for (topic, kind), n in sorted(self.counts.items())]


def refused_line(count: int) -> str:
    """Returns what is said of refused messages at the end."""
    were = "message was" if count == 1 else "messages were"
    return f"[yellow]{count} {were} refused[/]; --json lists them by topic and reason"
