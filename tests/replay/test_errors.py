"""The count of what was refused."""

import pytest

from replay.errors import LogError, OutputError, PredictorError, Refusals, ReplayError


def test_refusals_are_counted_by_topic_and_reason():
    refusals = Refusals()
    for topic, reason in (("/b", "NaN"), ("/a", "NaN"), ("/a", "absurd stamp"), ("/a", "NaN")):
        refusals.add(topic, 1_500_000_000, reason, "more words")
    assert refusals.total == 4
    assert refusals.as_json() == [
        {"topic": "/a", "reason": "NaN", "count": 2},
        {"topic": "/a", "reason": "absurd stamp", "count": 1},
        {"topic": "/b", "reason": "NaN", "count": 1},
    ]
    assert refusals.first[0] == "/b at 1.500 s refused: NaN (more words)"


def test_words_do_not_grow_with_the_log():
    refusals = Refusals()
    for i in range(10_000):
        refusals.add("/a", i, "NaN")
    assert len(refusals.first) == Refusals.KEPT
    assert refusals.total == 10_000


def test_strict_raises_at_the_first():
    with pytest.raises(LogError, match=r"/a at 1\.500 s refused: NaN; without --strict the run would go on"):
        Refusals(strict=True).add("/a", 1_500_000_000, "NaN")


@pytest.mark.parametrize("kind", [LogError, OutputError, PredictorError])
def test_whatever_a_user_can_mend_is_a_replay_error(kind):
    assert issubclass(kind, ReplayError)


def test_an_error_is_one_line_whatever_a_recording_calls_its_topics():
    error = LogError("no topic /a\nb\x1b[31m\u202e; its topics are " + "/" * 10_000)
    assert str(error).startswith(r"no topic /a\nb\x1b[31m\u202e; its topics are ///")
    assert str(error).isprintable()
    assert len(str(error)) < 2000
    assert str(LogError("/gmsl/A0 at 12 µs")) == "/gmsl/A0 at 12 µs"


def test_a_refusal_is_one_line():
    refusals = Refusals()
    refusals.add("/a\nb", 1, "not a \x1b[31m" + "x" * 5000)
    assert refusals.first[0].startswith(r"/a\nb at 0.000 s refused: not a \x1b[31mxxx")
    assert len(refusals.first[0]) < 2000


def test_reasons_that_quote_values_do_not_grow_with_the_log():
    refusals = Refusals()
    for i in range(5000):
        refusals.add("/a", i, f"x is {i}, more than 1e9")
    assert refusals.total == 5000
    assert len(refusals.as_json()) == Refusals.REASONS + 1
    assert {"topic": "/a", "reason": "other reasons", "count": 4000} in refusals.as_json()
