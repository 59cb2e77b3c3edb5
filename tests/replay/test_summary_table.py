"""The closing summary, in words."""

import io

import pytest
from rich.console import Console

from replay.errors import PredictorError
from replay.interrupts import Interrupted
from replay.record import Summary
from replay.summary_table import print_summary


def printed(summary, written=()):
    stream = io.StringIO()
    print_summary(summary, written, Console(file=stream, width=200))
    return stream.getvalue()


def test_what_was_done_and_how_well(recorded, tmp_path):
    text = printed(recorded.summary, [tmp_path / "out.mcap"])
    figures = recorded.summary.as_json()
    assert f"{figures['frames']} frames, {figures['tracks']} tracks, {figures['predictions']} predictions" in text
    assert f"{figures['ade_m']:.3f}" in text
    assert f"{figures['tracker']['ade_m']:.3f}" in text
    assert f"HOTA {figures['ground_truth']['hota']:.3f}" in text
    assert f"wrote {tmp_path / 'out.mcap'}" in text
    assert "refused" not in text
    assert "damaged" not in text
    assert "stopped" not in text


def test_what_was_refused_and_lost():
    summary = Summary(
        refused=7,
        first_refusals=[f"/a at {i}.000 s refused: NaN [bold]" for i in range(7)],
        salvage_losses=["drive.mcap: chunk at byte 10 is damaged (crc)"],
        restarts=2,
    )
    text = printed(summary)
    assert text.count("refused: NaN [bold]") == 5
    assert "7 messages were refused" in text
    assert "drive.mcap: chunk at byte 10 is damaged (crc)" in text
    assert "the file is damaged; every intact chunk was used" in text
    assert "the predictor was replaced 2 times; nothing was lost" in text


@pytest.mark.parametrize(
    ("stopped", "words"),
    [
        (
            PredictorError("the predictor died (exit code 7)"),
            "stopped early: the predictor died (exit code 7); what was",
        ),
        (Interrupted(2), "stopped early: SIGINT arrived; what was written is complete up to there"),
    ],
    ids=["predictor", "signal"],
)
def test_why_it_stopped(stopped, words):
    assert words in printed(Summary(stopped=stopped))


def test_an_empty_replay_prints_dashes():
    text = printed(Summary())
    assert "0 frames, 0 tracks, 0 predictions" in text
    assert "-" in text
