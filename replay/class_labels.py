"""Which classes a recording's boxes and tracks have, and a word where none of them means a pedestrian."""

from collections import Counter
from collections.abc import Collection

from schemas.messages import CameraDetections, ObjectTracks

KEPT = 1000  # different labels; a detector has a few hundred classes
SHOWN = 8


class ClassLabels:
    """Counts labels as they come."""

    def __init__(self, pedestrian: Collection[str]):
        self._pedestrian = {*pedestrian, ""}  # tracks without a label are taken for pedestrians
        self.counts: Counter[str] = Counter()

    def see(self, message: object) -> None:
        """Takes a message of any kind."""
        if isinstance(message, CameraDetections | ObjectTracks):
            for label in message.labels:
                if label in self.counts or len(self.counts) < KEPT:
                    self.counts[label] += 1

    @property
    def unmatched(self) -> list[str]:
        """The labels seen, the most frequent first, if there are some and none of them means a pedestrian."""
        if any(label in self._pedestrian for label in self.counts):
            return []
        return [label for label, _ in self.counts.most_common()]


def unmatched_line(labels: Collection[str]) -> str:
    """Returns what is said where no label means a pedestrian."""
    shown = ", ".join([*list(labels)[:SHOWN], *(["..."] if len(labels) > SHOWN else [])])
    return f"no label means a pedestrian; seen were {shown}: say which does with --pedestrian-label NAME"
