"""Which track is which: against all permutations, and under noise, gaps and people who walk side by side."""

from collections import Counter
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from replay.diff_pairs import Pair
from replay.diff_tracks import TRACKS, _most_together, match_tracks
from replay.logged_message import LoggedSchema, RawMessage
from schemas import pcgan_v1_pb2 as pb

SCHEMA = LoggedSchema(TRACKS, "protobuf", b"")


def raw(k, people, epoch=0):
    """A frame of id -> place."""
    frame = pb.TrackFrame(sequence=k, stamp_ns=k + 1, epoch=epoch)
    for number, (x, y) in people.items():
        frame.tracks.add(id=number, x=x, y=y)
    return RawMessage("/t", k, SCHEMA, "protobuf", frame.SerializeToString())


def matched(frames):
    """The matching of pairs of frames (a, b), each a dict of people or None."""
    return match_tracks(
        Pair("/t", k, *(None if people is None else raw(k, people) for people in pair)) for k, pair in enumerate(frames)
    )


@settings(max_examples=60)
@given(st.dictionaries(st.tuples(st.integers(0, 4), st.integers(0, 4)), st.integers(1, 9), max_size=10))
def test_as_many_frames_together_as_any_matching_has(counts):
    together = Counter({((0, a), (0, b)): n for (a, b), n in counts.items()})
    found = _most_together(together)
    assert len(set(found.values())) == len(found)
    best = max(sum(counts.get((a, b), 0) for a, b in enumerate(order)) for order in permutations(range(5)))
    assert sum(together[pair] for pair in found.items()) == best


@pytest.mark.parametrize("seed", range(5))
def test_a_crowd_in_noise_is_told_apart(seed):
    rng = np.random.default_rng(seed)
    numbers = np.arange(1, 21)
    new = rng.permutation(numbers) + 100
    start, step = rng.uniform(0, 15, (20, 2)), rng.normal(0, 0.1, (20, 2))
    frames = []
    for k in range(60):
        places = start + k * step
        seen = rng.random((2, 20)) < 0.9
        logs = [
            {int(number): tuple(place + rng.normal(0, 0.05, 2)) for number, place in zip(ids[there], places[there],
                                                                                       strict=True)}
            for ids, there in zip((numbers, new), seen, strict=True)
        ]  # fmt: skip
        frames.append(logs)
    assert matched(frames).renumbered == {str(a): str(b) for a, b in zip(numbers, new, strict=True)}


def test_two_who_always_walk_together_keep_their_numbers():
    beside = {1: (0.0, 0.0), 2: (0.0, 0.0)}
    assert matched([(beside, {1: (0.0, 0.1), 2: (0.0, -0.1)})] * 5).renumbered == {}


def test_frames_of_one_log_and_bytes_that_are_none_are_passed_over():
    good = raw(0, {1: (0.0, 0.0)})
    bad = good._replace(data=b"\xff")
    pairs = [Pair("/t", 0, good, None), Pair("/t", 1, bad, good), Pair("/t", 2, good, raw(2, {8: (0.0, 0.0)}))]
    assert match_tracks(pairs).renumbered == {"1": "8"}


@pytest.mark.parametrize("absurd", [float("nan"), float("inf"), 1e300, -1.7e308])
def test_absurd_places_match_nothing_else(absurd):
    people = ({1: (absurd, 0.0), 2: (5.0, 0.0)}, {3: (-absurd, 0.0), 4: (5.0, 0.0)})
    assert matched([people]).renumbered == {"2": "4"}


def test_epochs_are_told_by_sequence_or_by_time():
    def frame(k, epoch, number):
        return raw(k, {number: (0.0, 0.0)}, epoch)

    pairs = [Pair("/t", k, frame(k, int(k >= 3), 1), frame(k, int(k >= 3), 2)) for k in range(6)]
    found = match_tracks(pairs)
    assert [found.epoch(0, k, None) for k in range(6)] == [0, 0, 0, 1, 1, 1]
    assert [found.epoch(1, 0, k) for k in range(6)] == [0, 0, 0, 1, 1, 1]
    assert found.renumbered == {"1": "2", "1:1": "1:2"}
    assert found.key(0, (1, 1)) == found.key(1, (1, 2)) != found.key(1, (0, 2))
    assert found.key(0, (0, 2)) not in {found.key(1, (epoch, number)) for epoch in (0, 1) for number in (1, 2)}
