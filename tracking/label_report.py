"""What the tracker makes of every label after a scan, published or not: to look into, and to smooth."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np

from schemas.messages import FloatArray, IntArray
from tracking.mixture_reduction import GaussianMixture
from tracking.track_table import Labels


class Verdict(IntEnum):
    """Why a label is, or is not, a published track."""

    PUBLISHED = 0
    UNCONFIRMED = 1  # too few measurements so far, or none that convinced
    FADED = 2  # was confirmed; without measurements it has become unlikely to be there
    NO_PEDESTRIAN = 3  # something is there, but probably no person


@dataclass(frozen=True, eq=False)
class LabelReport:
    """Every label after one scan, oldest first. It gets an id once it is published.

    Its name stays the same, unless a late scan moves its birth; the id stays even then.
    """

    names: tuple[tuple[int, int], ...]  # (L,)  stamp of the scan it was born in, and where in it
    ids: IntArray  # (L,)  of the published track; 0: never published so far
    verdict: IntArray  # (L,)  a Verdict each
    measurement: IntArray  # (L,)  row of the scan's measurement that is the label's, or -1
    states: FloatArray  # (L, 4)  x, y, vx, vy of the heaviest component, odometry frame
    covariances: FloatArray  # (L, 4, 4)
    existence: FloatArray  # (L,)  probability that there is something
    pedestrian: FloatArray  # (L,)  probability that it is a pedestrian
    hidden: FloatArray  # (L,)  probability that the sensors cannot see it now
    hits: IntArray  # (L,)  measurements so far


def verdicts(labels: Labels, *, publish_existence: float, pedestrian_probability: float) -> IntArray:
    """Returns a Verdict for each label (L,); the first reason in the order of Verdict counts."""
    threshold = math.log(pedestrian_probability / (1 - pedestrian_probability))
    verdict = np.full(len(labels), int(Verdict.PUBLISHED))
    verdict[labels.class_log_odds < threshold] = Verdict.NO_PEDESTRIAN
    verdict[labels.existence < publish_existence] = Verdict.FADED
    verdict[~labels.confirmed] = Verdict.UNCONFIRMED
    return verdict


def report(
    labels: Labels, mixture: GaussianMixture, verdict: IntArray, id_of: Callable[[tuple[int, int]], int]
) -> LabelReport:
    """Returns the report; `mixture` is sorted by label, the heaviest component first, and holds every label."""
    heaviest = np.searchsorted(mixture.labels, np.arange(len(labels)))
    names = tuple(zip(labels.born_ns.tolist(), labels.born_index.tolist(), strict=True))
    return LabelReport(
        names,
        np.array([id_of(name) for name in names], np.int64),
        verdict,
        labels.measurement,
        mixture.means[heaviest],
        mixture.covs[heaviest],
        labels.existence,
        1 / (1 + np.exp(-labels.class_log_odds)),
        labels.hidden,
        labels.hits,
    )
