"""Ctrl-C, SIGTERM and SIGHUP: at once, after a shielded block, or not at all."""

import os
import signal
import threading
import time

import pytest

from replay.interrupts import REPEAT_S, Interrupted, Interrupts

SIGNALS = [signal.SIGINT, signal.SIGTERM, signal.SIGHUP]


def send(signum):
    os.kill(os.getpid(), signum)


def interrupted(work):
    """Does some work with an Interrupts; returns what interrupted it."""
    with pytest.raises(Interrupted) as interruption:
        enter(work)
    return interruption.value


def enter(work):
    with Interrupts() as interrupts:
        work(interrupts)


@pytest.mark.parametrize("signum", SIGNALS)
def test_a_signal_interrupts_at_once(signum):
    done = []

    def work(_):
        send(signum)
        done.append("after it")

    found = interrupted(work)
    assert (found.signum, str(found), done) == (signum, signal.Signals(signum).name, [])


@pytest.mark.parametrize("signum", SIGNALS)
def test_a_shielded_block_is_finished_first(signum):
    done = []

    def work(interrupts):
        with interrupts.shield():
            send(signum)
            done.append("block")
        done.append("after it")

    assert interrupted(work).signum == signum
    assert done == ["block"]


def test_between_blocks_a_signal_interrupts_at_once():
    done = []

    def work(interrupts):
        with interrupts.shield():
            done.append(1)
        send(signal.SIGINT)
        done.append(2)

    interrupted(work)
    assert done == [1]


def test_once_ignored_a_signal_changes_nothing():
    done = []

    def work(interrupts):
        interrupts.ignore()
        for signum in SIGNALS:
            send(signum)
            done.append(signum)

    enter(work)
    assert done == SIGNALS


def test_whoever_is_impatient_does_not_interrupt_the_tidying_up(monkeypatch):
    """A second signal, and more, while the first one is being obeyed; later ones are heard again."""
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    tidied = []

    def work(interrupts):
        try:
            with interrupts.shield():
                send(signal.SIGINT)
                send(signal.SIGTERM)
        finally:
            for signum in SIGNALS:
                send(signum)
                tidied.append(signum)
            clock[0] += REPEAT_S
            send(signal.SIGTERM)
            tidied.append("never")

    found = interrupted(work)
    assert (found.signum, tidied) == (signal.SIGTERM, SIGNALS)
    assert found.__context__.signum == signal.SIGINT  # the first of the two in the block


def test_where_nohup_has_sighup_ignored_it_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)
    try:
        with Interrupts():
            send(signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)


def test_an_error_in_a_shielded_block_is_not_hidden_by_a_signal():
    def work(interrupts):
        with interrupts.shield():
            send(signal.SIGINT)
            raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        enter(work)


def test_the_handlers_of_before_are_put_back():
    before = [signal.getsignal(signum) for signum in SIGNALS]
    with Interrupts():
        assert [signal.getsignal(signum) for signum in SIGNALS] != before
    assert [signal.getsignal(signum) for signum in SIGNALS] == before


def test_it_is_a_keyboard_interrupt():
    """Whoever handles Ctrl-C handles this, too, and `except Exception` does not swallow it."""
    assert issubclass(Interrupted, KeyboardInterrupt)


def test_off_the_main_thread_signals_are_left_alone():
    """Python lets only the main thread set handlers; a replay recorded in another thread must work all the same."""
    failures = []

    def enter():
        try:
            with Interrupts() as interrupts, interrupts.shield():
                pass
        except Exception as error:
            failures.append(error)

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join(10)
    assert failures == []
