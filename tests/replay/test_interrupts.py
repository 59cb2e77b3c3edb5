"""Ctrl-C and SIGTERM: at once, after a shielded block, or not at all."""

import os
import signal
import threading

import pytest

from replay.interrupts import Interrupted, Interrupts

SIGNALS = [signal.SIGINT, signal.SIGTERM]


def send(signum):
    os.kill(os.getpid(), signum)


@pytest.mark.parametrize("signum", SIGNALS)
def test_a_signal_interrupts_at_once(signum):
    with pytest.raises(Interrupted) as interruption, Interrupts():
        send(signum)
        pytest.fail("the signal was not noticed")
    assert interruption.value.signum == signum
    assert str(interruption.value) == signal.Signals(signum).name


@pytest.mark.parametrize("signum", SIGNALS)
def test_a_shielded_block_is_finished_first(signum):
    done = []
    with pytest.raises(Interrupted) as interruption, Interrupts() as interrupts:
        with interrupts.shield():
            send(signum)
            done.append("block")
        done.append("after it")
    assert done == ["block"]
    assert interruption.value.signum == signum


def test_between_blocks_a_signal_interrupts_at_once():
    done = []
    with pytest.raises(Interrupted), Interrupts() as interrupts:
        with interrupts.shield():
            done.append(1)
        send(signal.SIGINT)
        done.append(2)
    assert done == [1]


def test_once_ignored_a_signal_changes_nothing():
    with Interrupts() as interrupts:
        interrupts.ignore()
        for signum in SIGNALS:
            send(signum)


def test_an_error_in_a_shielded_block_is_not_hidden_by_a_signal():
    with pytest.raises(OSError, match="disk full"), Interrupts() as interrupts, interrupts.shield():
        send(signal.SIGINT)
        raise OSError("disk full")


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
