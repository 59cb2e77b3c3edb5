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
