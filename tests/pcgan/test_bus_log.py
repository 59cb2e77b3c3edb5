"""zenoh's log lines as sentences; that a real refusal leads to one is in tests/replay/test_security.py."""

import os

import pytest
import zenoh

from pcgan import bus_log

STAMP = "2026-11-25T21:44:10.882923Z"


@pytest.mark.parametrize(
    ("line", "said"),
    [
        (
            f"\x1b[2m{STAMP}\x1b[0m \x1b[33m WARN\x1b[0m acc-0 ThreadId(06) \x1b[2mzenoh_link_tls::unicast\x1b[0m"
            "\x1b[2m:\x1b[0m peer sent no certificates. Hint: increase the system open file limit.\n",
            "refused a peer: peer sent no certificates",
        ),
        (
            f"{STAMP} DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: UsrPwd extension - "
            "Recv OpenSyn. Invalid password. at /somewhere/usrpwd.rs:424.",
            "refused a peer: wrong password",
        ),
        (
            f"{STAMP} DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: New transport link "
            "accepted from fdb7 to 6665: TransportLinkUnicast {}",
            "",
        ),
        (f"{STAMP} ERROR net-0 ThreadId(04) zenoh_transport::unicast: it broke at /x/y.rs:1.", "zenoh: it broke"),
        ("serving predictions\n", None),
        ("", None),
    ],
)
def test_a_line_of_zenohs_log_becomes_a_sentence(line, said):
    assert bus_log.sentence(line) == said


WRONG_PASSWORD = (
    f"{STAMP} DEBUG acc-0 ThreadId(05) zenoh_transport::unicast::establishment::accept: UsrPwd extension - "
    "Recv OpenSyn. Invalid password. at /somewhere/usrpwd.rs:424.\n"
).encode()


@pytest.fixture
def levels(monkeypatch):
    """Keeps zenoh from writing a log for the rest of the test run; returns the filters it was asked for."""
    asked = []
    monkeypatch.delenv("RUST_LOG", raising=False)
    monkeypatch.setattr(zenoh, "init_log_from_env_or", asked.append)
    monkeypatch.setattr(zenoh, "try_init_log_from_env", lambda: asked.append("environment"))
    return asked


def test_refusals_are_told_at_growing_intervals_and_stdout_stays_what_it_was(levels, capfd):
    told = []
    with bus_log.refusals_told(told.append):
        os.write(1, b"a result\n")
        for _ in range(25):
            os.write(1, WRONG_PASSWORD)
        os.write(1, b"another\n")
    os.write(1, b"afterwards\n")
    assert told == ["refused a peer: wrong password", "refused a peer: wrong password (10 times)"]
    assert capfd.readouterr().out == "a result\nanother\nafterwards\n"
    assert levels == [bus_log.FILTER]


def test_whoever_asks_for_zenohs_own_log_gets_it(levels, monkeypatch, capfd):
    monkeypatch.setenv("RUST_LOG", "debug")
    told = []
    with bus_log.refusals_told(told.append):
        os.write(1, WRONG_PASSWORD)
    assert not told
    assert levels == ["environment"]
    assert capfd.readouterr().out.encode() == WRONG_PASSWORD


def test_a_listener_that_is_gone_does_not_stop_the_reader(levels, capfd):  # noqa: ARG001
    def tell(said):
        told.append(said)
        raise BrokenPipeError

    told = []
    with bus_log.refusals_told(tell):
        for _ in range(10):
            os.write(1, WRONG_PASSWORD)
    assert len(told) == 2
