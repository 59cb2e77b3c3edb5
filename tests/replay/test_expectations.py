"""What a suite may ask, how it is read, and what meets it."""

import pytest

from replay import PredictorChoice, Replay, record
from replay.check_result import TIMES, Judged, repeatable
from replay.expectations import figures, known_figures, parse_expectation

SUMMARY = {
    "complete": True,
    "refused": 2,
    "refusals": [{"topic": "/a", "count": 2}],
    "ade_m": None,
    "tracker": {"ade_m": 0.5},
    "model": {"name": "m"},
    "ground_truth": {"hota": 0.9, "ade_m": 0.25, "id_switches": 0},
}


@pytest.mark.parametrize(
    ("text", "figure", "value", "met"),
    [
        ("hota >= 0.9", "ground_truth.hota", 0.9, True),
        ("hota>0.9", "ground_truth.hota", 0.9, False),
        ("  ground_truth.ade_m   <= 0.3 ", "ground_truth.ade_m", 0.25, True),
        ("tracker.ade_m < .5", "tracker.ade_m", 0.5, False),
        ("refused == 2", "refused", 2, True),
        ("refused != 2", "refused", 2, False),
        ("no refused messages", "refused", 2, False),
        ("no id switches", "ground_truth.id_switches", 0, True),
        ("refusals == 1", "refusals", 1, True),  # a list counts as its length
        ("complete == 1", "complete", 1, True),
        ("fallbacks >= -1e-3", "fallbacks", None, False),  # not there
        ("ade_m <= 99", "ade_m", None, False),  # there, without a value: nothing was scored
    ],
)
def test_what_is_asked_and_what_comes_of_it(text, figure, value, met):
    expectation = parse_expectation(text)
    assert expectation.figure == figure
    assert expectation.judge(SUMMARY) == Judged(" ".join(text.split()), value, met)


def test_a_bare_name_at_the_top_is_not_the_one_of_the_ground_truth():
    """ade_m is the error against later tracks, which every log has; the truth's is ground_truth.ade_m."""
    assert parse_expectation("ade_m <= 1").figure == "ade_m"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hoat >= 0.8", "no replay has a figure called hoat; did you mean hota or mota?"),
        ("groundtruth.hota >= 0.8", "did you mean ground_truth.hota"),
        ("no luck messages", "no replay has a figure called luck; "),
        ("hota >= much", "'much' in 'hota >= much' is no number"),
        ("hota >= nan", "'nan' in 'hota >= nan' is no finite number"),
        ("hota = 0.8", "an expectation reads like 'hota >= 0.8' or 'no refused messages', got 'hota = 0.8'"),
        (0.8, "got 0.8"),
        ("", "got ''"),
    ],
)
def test_what_makes_no_sense_is_told_at_once(text, words):
    with pytest.raises(ValueError) as refusal:  # noqa: PT011  the words are compared
        parse_expectation(text)
    assert words in str(refusal.value)


def test_every_figure_of_a_summary_is_known_and_no_other(recorded):
    summary = recorded.summary.as_json()
    with_nones = set(figures({name: _filled(value) for name, value in summary.items()}))
    assert with_nones == known_figures()


def _filled(value):
    """The value with numbers where a drive as short as this has none."""
    if isinstance(value, dict):
        return {name: _filled(each) for name, each in value.items()}
    return 0.0 if value is None else value


def test_only_times_differ_from_run_to_run(short_drive, model):
    runs = [record(Replay([short_drive], predictor=PredictorChoice("inline", model))).as_json() for _ in range(2)]
    assert repeatable(runs[0]) == repeatable(runs[1])
    assert runs[0].keys() - repeatable(runs[0]).keys() == TIMES
