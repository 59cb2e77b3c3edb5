"""Frame reports added up while they stream by: who was missed for how long and why, and when to look closer."""

from collections import Counter
from dataclasses import dataclass, field

from replay.inspection import BoxReport, ClusterReport, FrameReport, Miss, Outcome

LONGEST_STEP_S = 0.5  # a longer gap between frames counts as this much
MIN_SPELL_S = 0.5  # boxes and clusters untracked for less than this are not worth a line
MIN_SCORE, MIN_PROBABILITY = 0.5, 0.7
MAX_GAP_S = 0.35  # a spell survives as many seconds without its box or cluster
SAME_BOX = 0.3  # intersection over union of a box with the one before


@dataclass(frozen=True)
class Spell:
    """A stretch of time for which somebody, or something, was not tracked; times are seconds into the log."""

    from_s: float  # by the scans' stamps: frames that were released together lie apart
    to_s: float
    look_at_s: float  # a frame of it, about half way: by log time, which is what --at takes
    reason: str  # most frequent one

    @property
    def length_s(self) -> float:
        """How long it lasted."""
        return self.to_s - self.from_s


@dataclass(frozen=True)
class PersonSummary:
    """A person of the ground truth over the whole time; only scans with 4 LiDAR points on that person count."""

    id: int
    seen_s: float
    missed_s: float
    track_ids: tuple[int, ...]  # that stood for the person, in order
    longest: Spell | None  # in a row
    reasons: dict[str, float]  # miss -> s


@dataclass(frozen=True)
class Switch:
    """A person who got another track id."""

    at_s: float
    person: int
    before: int
    after: int


@dataclass(frozen=True)
class UntrackedBoxes:
    """A box that was there from image to image, with a score of 0.5 or more, and had no track."""

    camera: str
    score: float  # mean
    middle_px: tuple[float, float]  # of the box half way
    spell: Spell


@dataclass(frozen=True)
class UntrackedCluster:
    """A measurement that looked like a pedestrian, from scan to scan, and was not tracked."""

    ahead_m: float  # half way
    left_m: float
    pedestrian_probability: float  # mean
    spell: Spell


@dataclass(frozen=True)
class InspectionSummary:
    """What a stretch of a log came to."""

    frames: int
    from_s: float
    to_s: float
    seen_s: float  # person-seconds with 4 LiDAR points or more
    missed_s: float  # of them, without a track
    reasons: dict[str, float]  # miss -> person-seconds, most first
    people: tuple[PersonSummary, ...]  # missed longest first
    switches: tuple[Switch, ...]
    boxes: tuple[UntrackedBoxes, ...]  # longest first
    clusters: tuple[UntrackedCluster, ...]  # longest first
    has_truth: bool


@dataclass
class _Person:
    seen_s: float = 0.0
    missed_s: float = 0.0
    track_ids: list[int] = field(default_factory=list)
    reasons: dict[str, float] = field(default_factory=dict)
    spells: list[Spell] = field(default_factory=list)
    missing: "_Open | None" = None


@dataclass
class _Open:
    """A spell that may go on."""

    from_s: float
    to_s: float = 0.0  # when it was so last
    frames_s: list[float] = field(default_factory=list)  # log times at which it was so
    reasons: Counter[str] = field(default_factory=Counter)
    boxes: list[BoxReport] = field(default_factory=list)
    clusters: list[ClusterReport] = field(default_factory=list)

    def spell(self) -> Spell:
        """Returns it as one that is over."""
        look_at_s = self.frames_s[len(self.frames_s) // 2]
        return Spell(self.from_s, self.to_s, look_at_s, self.reasons.most_common(1)[0][0])

    def add(self, now_s: float, report: FrameReport, reason: str) -> None:
        """Takes one more frame of it."""
        self.to_s = now_s
        self.frames_s.append(report.at_s)
        self.reasons[reason] += 1


class InspectionLog:
    """Takes frames in order; `summary` at the end."""

    def __init__(self) -> None:
        self._frames = 0
        self._from_s = self._to_s = 0.0
        self._first: FrameReport | None = None  # of the epoch
        self._now_s = 0.0  # seconds into the log, by stamps
        self._has_truth = False
        self._people: dict[int, _Person] = {}
        self._switches: list[Switch] = []
        self._boxes: dict[str, list[_Open]] = {}
        self._labels: dict[tuple[int, int], _Open] = {}
        self._untracked_boxes: list[UntrackedBoxes] = []
        self._untracked_clusters: list[UntrackedCluster] = []

    def add(self, report: FrameReport) -> None:
        """Takes the next frame."""
        if self._first is None or self._first.epoch != report.epoch:
            self._now_s = report.at_s  # seconds before and after a clock reset do not compare
            self._first = report
        if self._frames == 0:
            self._from_s = report.at_s
        before_s, self._now_s = self._now_s, self._first.at_s + (report.stamp_ns - self._first.stamp_ns) / 1e9
        self._frames += 1
        self._to_s = report.at_s
        self._add_people(report, min(self._now_s - before_s, LONGEST_STEP_S))
        self._add_boxes(report)
        self._add_clusters(report)

    def _add_people(self, report: FrameReport, step_s: float) -> None:
        self._has_truth |= report.people is not None
        for seen in report.people or ():
            if seen.miss == Miss.FEW_POINTS:
                continue
            person = self._people.setdefault(seen.id, _Person())
            person.seen_s += step_s
            if seen.miss is None:
                self._close(person)
                if person.track_ids and person.track_ids[-1] != seen.track_id:
                    self._switches.append(Switch(report.at_s, seen.id, person.track_ids[-1], seen.track_id))
                if not person.track_ids or person.track_ids[-1] != seen.track_id:
                    person.track_ids.append(seen.track_id)
                continue
            person.missed_s += step_s
            person.reasons[seen.miss] = person.reasons.get(seen.miss, 0.0) + step_s
            if person.missing is not None and self._now_s - person.missing.to_s > MAX_GAP_S:
                self._close(person)  # there were too few points in between to miss anybody
            person.missing = person.missing or _Open(self._now_s - step_s)
            person.missing.add(self._now_s, report, seen.miss)

    @staticmethod
    def _close(person: _Person) -> None:
        if person.missing is not None:
            person.spells.append(person.missing.spell())
            person.missing = None

    def _add_boxes(self, report: FrameReport) -> None:
        """Chains boxes without a track from image to image: a box belongs to the chain whose last one it overlaps."""
        for chains in self._boxes.values():
            self._drop_old(chains)
        for box in report.boxes:
            if box.score < MIN_SCORE or box.outcome == Outcome.TRACKED:
                continue
            chains = self._boxes.setdefault(box.camera, [])
            chain = max(chains, key=lambda open_: _iou(open_.boxes[-1], box), default=None)
            if chain is None or _iou(chain.boxes[-1], box) < SAME_BOX:
                chain = _Open(self._now_s)
                chains.append(chain)
            chain.add(self._now_s, report, box.outcome)
            chain.boxes.append(box)

    def _drop_old(self, chains: list[_Open]) -> None:
        for chain in [c for c in chains if c.to_s < self._now_s - MAX_GAP_S]:
            chains.remove(chain)
            self._keep_boxes(chain)

    def _keep_boxes(self, chain: _Open) -> None:
        if chain.to_s - chain.from_s >= MIN_SPELL_S:
            x0, y0, x1, y1 = chain.boxes[len(chain.boxes) // 2].corners_px
            score = sum(box.score for box in chain.boxes) / len(chain.boxes)
            middle = ((x0 + x1) / 2, (y0 + y1) / 2)
            self._untracked_boxes.append(UntrackedBoxes(chain.boxes[0].camera, score, middle, chain.spell()))

    def _add_clusters(self, report: FrameReport) -> None:
        """Follows labels that are no track, scan by scan, though what they measured looks like a person."""
        for name in [name for name, open_ in self._labels.items() if open_.to_s < self._now_s - MAX_GAP_S]:
            self._end(name)
        for cluster in report.clusters:
            if cluster.label is None:
                continue
            if cluster.outcome is Outcome.TRACKED:
                self._end(cluster.label)
            elif (cluster.pedestrian_probability or 0.0) >= MIN_PROBABILITY:
                spell = self._labels.setdefault(cluster.label, _Open(self._now_s))
                spell.add(self._now_s, report, cluster.outcome)
                spell.clusters.append(cluster)

    def _end(self, name: tuple[int, int]) -> None:
        spell = self._labels.pop(name, None)
        if spell is not None and spell.to_s - spell.from_s >= MIN_SPELL_S:
            half_way = spell.clusters[len(spell.clusters) // 2]
            mean = sum(c.pedestrian_probability or 0.0 for c in spell.clusters) / len(spell.clusters)
            self._untracked_clusters.append(UntrackedCluster(half_way.ahead_m, half_way.left_m, mean, spell.spell()))

    def summary(self) -> InspectionSummary:
        """Returns what has been added so far."""
        for chains in self._boxes.values():
            for chain in chains:
                self._keep_boxes(chain)
        self._boxes.clear()
        for name in list(self._labels):
            self._end(name)
        reasons: dict[str, float] = {}
        for person in self._people.values():
            self._close(person)
            for reason, missed_s in person.reasons.items():
                reasons[reason] = reasons.get(reason, 0.0) + missed_s
        people = [
            PersonSummary(
                number,
                person.seen_s,
                person.missed_s,
                tuple(person.track_ids),
                max(person.spells, key=lambda spell: spell.length_s, default=None),
                _most_first(person.reasons),
            )
            for number, person in self._people.items()
        ]
        return InspectionSummary(
            self._frames,
            self._from_s,
            self._to_s,
            sum(person.seen_s for person in people),
            sum(person.missed_s for person in people),
            _most_first(reasons),
            tuple(sorted(people, key=lambda person: (-person.missed_s, person.id))),
            tuple(self._switches),
            tuple(sorted(self._untracked_boxes, key=lambda boxes: -boxes.spell.length_s)),
            tuple(sorted(self._untracked_clusters, key=lambda cluster: -cluster.spell.length_s)),
            self._has_truth,
        )


def _most_first(seconds: dict[str, float]) -> dict[str, float]:
    return dict(sorted(seconds.items(), key=lambda item: -item[1]))


def _iou(a: BoxReport, b: BoxReport) -> float:
    width = min(a.corners_px[2], b.corners_px[2]) - max(a.corners_px[0], b.corners_px[0])
    height = min(a.corners_px[3], b.corners_px[3]) - max(a.corners_px[1], b.corners_px[1])
    if width <= 0 or height <= 0:
        return 0.0
    return width * height / (_area(a) + _area(b) - width * height)


def _area(box: BoxReport) -> float:
    x0, y0, x1, y1 = box.corners_px
    return (x1 - x0) * (y1 - y0)
