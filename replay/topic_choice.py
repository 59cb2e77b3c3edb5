"""Which topics to play or record: by name, by regular expression, or all but some."""

import re
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Self


@dataclass(frozen=True)
class TopicChoice:
    """The topics that are named or match `regex`, all if there is neither; without those that match `exclude`."""

    names: frozenset[str] = frozenset()  # with their leading slash
    regex: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None

    @classmethod
    def of(cls, names: Iterable[str] = (), regex: str | None = None, exclude: str | None = None) -> Self:
        """Reads options: names, several with commas between, the leading slash optional; and two expressions.

        An expression may match anywhere in a name. Raises ValueError for one that cannot be read.
        """
        split = [name.strip() for option in names for name in option.split(",")]
        return cls(frozenset(_rooted(name) for name in split if name), _compiled(regex), _compiled(exclude))

    def wants(self, topic: str) -> bool:
        """Tells whether a topic is chosen."""
        topic = _rooted(topic)
        if self.exclude is not None and self.exclude.search(topic):
            return False
        if not self.names and self.regex is None:
            return True
        return topic in self.names or (self.regex is not None and self.regex.search(topic) is not None)


def _rooted(name: str) -> str:
    return "/" + name.removeprefix("/")


def _compiled(expression: str | None) -> re.Pattern[str] | None:
    if expression is None:
        return None
    try:
        return re.compile(expression)
    except re.error as error:
        raise ValueError(f"{expression!r} is no regular expression: {error}") from error
