"""Whole recordings, damaged in every way: each ends as if nothing had happened, with what was lost told, or in a line.

`python -m benchmarks.robustness` prints the same as a table.
"""

from collections import Counter
from dataclasses import replace
from random import Random

import pytest

from benchmarks.robustness import trial
from benchmarks.robustness.mcap_map import Content, read_map
from benchmarks.robustness.mutations import DAMAGE, FORGERIES, Mutation, Stretch, mutate
from benchmarks.robustness.sources import make_sources
from benchmarks.robustness.trial import FORBIDDEN, KINDS, LOST, Report, run, try_one
from replay.log_reader import LogReader


@pytest.fixture(scope="module")
def sources(tmp_path_factory):
    return make_sources(tmp_path_factory.mktemp("sources"))


def assert_nothing_forbidden(report):
    assert not report.failures, report.failures[:5]
    assert not any(report.count(what) for what in FORBIDDEN)


def test_a_hundred_mutated_logs(sources, tmp_path):
    report = run(sources, tmp_path, files=100, seed=7)
    assert_nothing_forbidden(report)
    assert report.files.total() == 100
    assert report.expected > 5000
    for outcome in (trial.CLEAN, trial.NOTED, trial.REFUSED, trial.ONE_LINE):
        assert report.count(outcome) > 3, outcome


@pytest.mark.slow
def test_five_thousand_mutated_logs(sources, tmp_path):
    report = run(sources, tmp_path, files=5000)
    assert_nothing_forbidden(report)
    assert report.files.total() == 5000
    assert len(report.files) == len(sources) * len(KINDS)  # every way, of every kind of file
    assert report.expected > 400_000
    assert report.peak_bytes < trial.MEMORY_BYTES


# --- the measure itself ----------------------------------------------------------------------------------------------


def test_the_map_finds_what_the_reader_finds(sources, tmp_path):
    """Over intact files, two readers that share no code."""
    for source in sources:
        path = tmp_path / "intact.mcap"
        path.write_bytes(source.map.data)
        for salvage in (False, True):
            reader = LogReader([path], salvage=salvage)
            found = Counter(Content(m.topic, m.log_time_ns, m.data) for m in reader.messages())
            assert found == source.map.messages, source.name
            assert reader.losses.notes == []


def test_what_is_kept_of_a_file_is_there_in_one_piece(sources):
    """Every stretch that counts as kept is found in the mutated file as it was."""
    for number, kind in enumerate([*DAMAGE, *FORGERIES] * 3):
        source = sources[number % len(sources)].map
        mutation = mutate(source, kind, Random(number))
        data = mutation.applied(source.data)
        for start, end in mutation.kept():
            assert source.data[start:end] in data, kind


def test_stretches_side_by_side_are_one_and_others_are_not():
    whole = Mutation("", (Stretch(0, 4), b"", Stretch(4, 9)))
    assert whole.kept() == [(0, 9)]
    assert whole.applied(b"012345678") == b"012345678"
    changed = Mutation("", (Stretch(0, 4), b"x", Stretch(4, 9), Stretch(2, 5), Stretch(5, 6)))
    assert changed.kept() == [(0, 4), (4, 9), (2, 6)]
    assert changed.applied(b"012345678") == b"0123x456782345"


def test_a_reader_that_loses_a_chunk_is_caught(sources, tmp_path, monkeypatch):
    """The trial must not be blind: here salvage leaves out what is logged in the first 200 ms."""
    real = LogReader.messages

    def forgetful(self, topics=None, start_ns=None, end_ns=None):
        return real(self, topics, (start_ns or self.start_ns) + 200_000_000, end_ns)

    monkeypatch.setattr(LogReader, "messages", forgetful)
    report = Report()
    try_one(report, sources, sources[0], "flipped bits", 1, tmp_path, whole=False)
    assert report.count(LOST)
    assert report.failures[0].kind == "flipped bits"


def test_a_reader_that_makes_a_message_up_or_raises_is_caught(sources, tmp_path, monkeypatch):
    real = LogReader.messages

    def inventive(self, *arguments):
        for message in real(self, *arguments):
            yield message._replace(data=message.data + b"!")

    monkeypatch.setattr(LogReader, "messages", inventive)
    report = Report()
    try_one(report, sources, sources[0], "wrong magic", 1, tmp_path, whole=False)
    assert report.count(trial.INVENTED)

    def broken(*_):
        raise IndexError("never thought of")

    monkeypatch.setattr(LogReader, "messages", broken)
    report = Report()
    try_one(report, sources, sources[0], "wrong magic", 1, tmp_path, whole=False)
    assert report.count(trial.TRACEBACK)
    assert "never thought of" in report.failures[0].detail


def test_a_reader_that_hangs_or_takes_all_memory_is_caught(sources, tmp_path, monkeypatch):
    monkeypatch.setattr(trial, "PATIENCE_S", 0.2)

    def endless(*_):
        while True:
            pass

    monkeypatch.setattr(LogReader, "messages", endless)
    report = Report()
    try_one(report, sources, sources[0], "wrong magic", 1, tmp_path, whole=False)
    assert report.count(trial.HANG)

    monkeypatch.setattr(LogReader, "messages", lambda *_: iter(bytearray(8 << 30)))
    report = Report()
    try_one(report, sources, sources[0], "wrong magic", 1, tmp_path, whole=False)
    assert report.count(trial.MEMORY)


def test_the_same_seed_gives_the_same_file(sources):
    source = sources[0].map
    files = [mutate(source, "flipped bits", Random(5)).applied(source.data) for _ in range(2)]
    assert files[0] == files[1] != source.data


def test_a_map_is_of_an_intact_file(sources):
    with pytest.raises(AssertionError):
        read_map(replace(sources[0].map, data=b"").data)
