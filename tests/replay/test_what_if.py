"""Two futures of one moment: hypotheses, path files, what is compared, and asking over zenoh."""

import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import zenoh

from pcgan import bus
from pcgan.predictor import Predictor
from pcgan.predictor_process import Inbox, serve, what_if_key
from pcgan.vehicle_path import Motion
from replay import LogError, PredictorChoice, PredictorError, Replay
from replay.session import ReplaySettings
from replay.what_if import (
    WhatIfError,
    as_json,
    ask_what_if,
    braking,
    compare,
    following,
    frame_at,
    read_path,
    swerving,
    what_if,
)
from replay.what_if_view import WhatIfView, what_if_view
from schemas import codec
from schemas.messages import PredictionFrame, TrackFrame, VehicleHistory

RERUN = Path(sys.executable).with_name("rerun")
TURNED = Motion(10.0, 20.0, np.pi / 2, 4.0, 0.0)


@pytest.fixture(scope="module")
def predictor(model):
    return Predictor.from_checkpoint(model)


@pytest.fixture
def frame(make):
    """A vehicle at 4 m/s along y from (10, 20), and four who stand: near and far ahead, aside, and within."""
    ages_s = np.arange(36, -1, -1) / 10
    states = np.array([[10, 20 - 4 * age, np.pi / 2, 0, 4] for age in ages_s])
    vehicle = VehicleHistory(make.stamp(0) - np.round(ages_s * 1e9).astype(np.int64), states)
    places = {1: (10, 26), 2: (10, 30), 3: (5, 22), 4: (10.5, 21)}
    tracks = tuple(make.track(0, id, (*place, 0, 0), covariance=np.diag([1e-4] * 4)) for id, place in places.items())
    return TrackFrame(7, make.stamp(0), "odom", vehicle, tracks)


def write(path, text):
    path.write_text(text)
    return path


# --- path files ------------------------------------------------------------------------------------------------------


def test_path_is_seen_from_the_vehicle(tmp_path):
    file = write(tmp_path / "plan.csv", "t,x,y,yaw\n0,0,0,0\n1.5,4,1,0.5\n")
    path = following(file).path(TURNED, np.zeros(1))
    np.testing.assert_allclose(path.times_s, [0, 1.5])
    np.testing.assert_allclose(path.poses, [[10, 20, np.pi / 2], [9, 24, np.pi / 2 + 0.5]])


def test_without_a_yaw_the_vehicle_points_where_it_drives(tmp_path):
    file = write(tmp_path / "plan.csv", "t, x, y\r\n0,0,0\r\n\r\n1,2,0\n2,2,0\n3,2,3\n4,1,3\n5,0,2.9\n")
    times_s, poses = read_path(file)
    np.testing.assert_allclose(times_s, range(6))
    left = np.pi / 2
    np.testing.assert_allclose(poses[:5, 2], [0, 0, 0, left, 2 * left])
    assert poses[5, 2] == pytest.approx(np.pi + 0.0997, abs=1e-4)  # and no jump to the other side


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("", "must begin with the line t,x,y or t,x,y,yaw; it begins with ''"),
        ("x,y,t\n0,0,0\n", "it begins with 'x,y,t'"),
        ("0,0,0\n1,1,1\n", "it begins with '0,0,0'"),
        ("t,x,y\n", "has no poses"),
        ("t,x,y\n0,0\n", "line 2 should hold 3 numbers, and is '0,0'"),
        ("t,x,y,yaw\n0,0,0,0\n1,1,1\n", "line 3 should hold 4 numbers"),
        ("t,x,y\n0,0,zero\n", "line 2 should hold 3 numbers, and is '0,0,zero'"),
        ("t,x,y\n0,0,nan\n", "line 2 should hold 3 numbers"),
        ("t,x,y\n\n0,0,0\n\n1,1e300,0\n", "line 5 should hold 3 numbers, and is '1,1e300,0'"),
        ("t,x,y\n0.5,0,0\n1,1,0\n", "t must begin with 0 and rise"),
        ("t,x,y\n0,0,0\n1,1,0\n1,2,0\n", "t must begin with 0 and rise"),
    ],
)
def test_files_that_hold_no_path_are_refused(tmp_path, text, problem):
    file = write(tmp_path / "plan.csv", text)
    with pytest.raises(WhatIfError) as error:
        read_path(file)
    assert str(error.value).startswith(str(file))
    assert problem in str(error.value)


def test_a_file_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(WhatIfError, match="cannot be read: No such file"):
        following(tmp_path / "none.csv")


# --- both futures ----------------------------------------------------------------------------------------------------


def test_braking_spares_who_stands_further_ahead(predictor, frame):
    """Within 1.2 s it drives 4.8 m, or stops after 2 m: its front gets to 27.2 m or 24.4 m, margin not counted."""
    found = what_if(predictor.step, frame, braking(4.0))
    assert (found.driven_on.name, found.supposed.name) == ("drives on", "brakes")
    assert found.horizon_s == pytest.approx(1.2)
    np.testing.assert_allclose(found.supposed.path.poses[-1], [10, 22, np.pi / 2])
    np.testing.assert_allclose(found.supposed.path.times_s, 0.1 * np.arange(13))
    people = {person.id: person for person in compare(found)}
    chances = {id: (p.driven_on.probability, p.supposed.probability) for id, p in people.items()}
    assert chances == {1: (1, 0), 2: (0, 0), 3: (0, 0), 4: (1, 1)}
    assert (people[1].driven_on.time_s, people[1].supposed.time_s) == (0, None)
    assert [person.id for person in compare(found)] == [4, 1, 3, 2]
    assert [person.concerned for person in compare(found)] == [True, True, False, False]
    places = {id: (p.ahead_m, p.left_m, p.distance_m) for id, p in people.items()}
    assert places[1] == pytest.approx((6, 0, 3.6))
    assert places[3] == pytest.approx((2, 5, 4.3))
    assert places[4] == pytest.approx((1, -0.5, 0))


def test_swerving_moves_the_corridor_aside(predictor, frame):
    slow = swerving(True, 1.5, 1.0)
    with pytest.raises(WhatIfError, match=r"at 4\.0 m/s the vehicle cannot shift 1\.5 m within 1 s"):
        what_if(predictor.step, frame, slow)
    for left, sign in ((True, -1), (False, 1)):  # left of +y is -x
        path = what_if(predictor.step, frame, swerving(left, 1.0, 1.2)).supposed.path
        assert path.poses[-1, 0] == pytest.approx(10 + sign)


def test_a_logged_plan_does_not_count_as_driving_on(predictor, frame):
    found = what_if(predictor.step, frame, braking(4.0))
    planned = replace(frame, vehicle_path=found.supposed.path)
    again = what_if(predictor.step, planned, braking(4.0))
    np.testing.assert_array_equal(again.driven_on.path.poses, found.driven_on.path.poses)


def test_a_vehicle_that_is_not_known_supposes_nothing(predictor, frame):
    with pytest.raises(WhatIfError, match="motion at this moment is not known"):
        what_if(predictor.step, replace(frame, vehicle_history=VehicleHistory.empty()), braking(3.0))


def test_json_holds_both_futures(predictor, frame):
    found = what_if(predictor.step, frame, braking(4.0))
    figures = as_json(found, compare(found))
    assert figures["vehicle"]["speed_mps"] == 4
    assert figures["horizon_s"] == 1.2
    assert figures["paths"]["supposed"]["y"][-1] == 22
    assert set(figures["paths"]["driven_on"]) == {"t", "x", "y", "yaw"}
    first, second, *_ = figures["pedestrians"]
    assert (first["id"], second["id"]) == (4, 1)
    assert second["driven_on"] == {"probability": 1.0, "time_s": 0.0}
    assert second["supposed"] == {"probability": 0.0, "time_s": None}


def test_frame_nearest_a_moment(short_drive, model):
    def found(at_s, **settings):
        with Replay([short_drive], ReplaySettings(**settings), PredictorChoice("inline", model)) as run:
            frame = frame_at(run, at_s)
            return (frame.log_time_ns - run.reader.start_ns) / 1e9, frame.tracks.sequence

    at_s, sequence = found(1.5, duration_s=2.5)
    assert at_s == pytest.approx(1.5, abs=0.06)
    assert sequence == pytest.approx(14, abs=2)
    with pytest.raises(LogError, match="there is no frame within 1 s of 9 s into the log"):
        found(9.0)


# --- the view --------------------------------------------------------------------------------------------------------


def test_view_shows_both_futures(predictor, frame, tmp_path):
    found = what_if(predictor.step, frame, braking(4.0))
    with what_if_view(tmp_path / "f.rrd", False, "test") as view:
        assert isinstance(view, WhatIfView)
        view.show_futures(found, compare(found))
    printed = subprocess.run([RERUN, "rrd", "print", tmp_path / "f.rrd"], capture_output=True, text=True, check=True)
    wanted = {"grid", "corridor", "vehicle", "people/concerned", "people/others", "paths"}
    for entity in {f"/{root}/{name}" for root in ("driven_on", "supposed") for name in wanted} | {"/figures"}:
        assert f" {entity} " in printed.stdout
    with what_if_view(None, False, "test") as nothing:
        assert nothing is None


def test_view_of_nobody(predictor, frame, tmp_path):
    found = what_if(predictor.step, replace(frame, tracks=()), braking(4.0))
    with what_if_view(tmp_path / "f.rrd", False, "test") as view:
        view.show_futures(found, compare(found))
    assert (tmp_path / "f.rrd").stat().st_size > 1000


# --- asking over zenoh -----------------------------------------------------------------------------------------------


@contextmanager
def answering(endpoint, answer, namespace="", delay_s=0.0):
    """A queryable on a bus of its own, declared after a while."""
    with bus.open_session(listen=[endpoint]) as session:
        questions = []

        def serve():
            time.sleep(delay_s)
            questions.append(session.declare_queryable(what_if_key(namespace), answer))

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield
        finally:
            thread.join()
            for question in questions:
                question.undeclare()


@pytest.mark.parametrize(("namespace", "delay_s"), [("", 0.0), ("car7", 0.5)])
def test_a_running_predictor_answers_as_ours_does(predictor, frame, tmp_path, namespace, delay_s):
    def answer(query):
        with query:
            asked = codec.decode(TrackFrame, query.payload.to_bytes())
            query.reply(str(query.key_expr), codec.encode(predictor.step(asked)))

    endpoint = f"unixsock-stream/{tmp_path}/bus"
    with answering(endpoint, answer, namespace, delay_s), bus.open_session(connect=[endpoint]) as session:
        remote = what_if(lambda tracks: ask_what_if(session, tracks, namespace), frame, braking(4.0))
    ours = what_if(predictor.step, frame, braking(4.0))
    assert codec.encode(remote.supposed.answer) == codec.encode(ours.supposed.answer)
    assert as_json(remote, compare(remote)) == as_json(ours, compare(ours))


def test_who_holds_the_question_back_has_not_refused_it(frame, tmp_path):
    endpoint, held = f"unixsock-stream/{tmp_path}/bus", []
    with (
        answering(endpoint, held.append),
        bus.open_session(connect=[endpoint]) as session,
        pytest.raises(PredictorError, match=r"no predictor answered on pcgan/predict within 0\.6 s"),
    ):
        ask_what_if(session, frame, timeout_s=0.6)
    for query in held:
        query.drop()


@pytest.mark.parametrize("namespace", ["", "car7"])
def test_pcgan_predict_answers_as_ours_does_and_says_what_it_refuses(predictor, frame, tmp_path, namespace):
    """The process that `pcgan predict` is, not a double of it."""
    endpoint, inbox, refused = f"unixsock-stream/{tmp_path}/bus", Inbox(), []
    identity = bus.ModelIdentity(predictor.model_name, predictor.checksum)
    with bus.open_session(listen=[endpoint]) as serving, bus.open_session(connect=[endpoint]) as session:
        thread = threading.Thread(
            target=lambda: refused.append(serve(serving, predictor, identity, inbox, namespace=namespace))
        )
        thread.start()
        try:
            ask = partial(ask_what_if, session, namespace=namespace)
            remote = what_if(ask, frame, braking(4.0))
            with pytest.raises(PredictorError, match=r"refused the frame: .*stamp"):
                ask(replace(frame, stamp_ns=0))
            assert ask(frame).sequence == frame.sequence  # it goes on
        finally:
            inbox.close()
            thread.join(10)
    ours = what_if(predictor.step, frame, braking(4.0))
    assert codec.encode(remote.supposed.answer) == codec.encode(ours.supposed.answer)
    assert as_json(remote, compare(remote)) == as_json(ours, compare(ours))
    assert refused == [1]


def test_nobody_answers(frame, tmp_path):
    endpoint = f"unixsock-stream/{tmp_path}/bus"
    with bus.open_session(listen=[endpoint]) as session:
        begun = time.monotonic()
        with pytest.raises(
            PredictorError, match=r"no predictor answered on pcgan/predict within 0\.4 s; start one with"
        ):
            ask_what_if(session, frame, timeout_s=0.4)
        assert time.monotonic() - begun < 5


@pytest.mark.parametrize(
    ("reply", "problem"),
    [
        (lambda query, _: query.reply_err(b"tracks [8] hold NaN"), r"refused the frame: tracks \[8\] hold NaN"),
        (lambda query, _: query.reply_err(b"\xff\xff"), "refused the frame: \ufffd\ufffd"),
        (lambda query, _: query.reply(str(query.key_expr), b"\xff\xff"), "is no prediction"),
        (
            lambda query, asked: query.reply(
                str(query.key_expr), codec.encode(PredictionFrame(asked.sequence + 1, asked.stamp_ns, "odom", "m", 0.1))
            ),
            "answered another frame: 8, not 7",
        ),
        (
            lambda query, asked: query.reply(
                str(query.key_expr), codec.encode(PredictionFrame(asked.sequence, asked.stamp_ns, "odom", "m", 0.1))
            ),
            "did not answer for the frame's tracks",
        ),
    ],
)
def test_answers_that_are_none(frame, tmp_path, reply, problem):
    def answer(query: zenoh.Query):
        with query:
            reply(query, codec.decode(TrackFrame, query.payload.to_bytes()))

    endpoint = f"unixsock-stream/{tmp_path}/bus"
    with (
        answering(endpoint, answer),
        bus.open_session(connect=[endpoint]) as session,
        pytest.raises(PredictorError, match=problem),
    ):
        ask_what_if(session, frame)
