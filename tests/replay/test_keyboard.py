"""Keys at a terminal: read one at a time, and the terminal is afterwards what it was before."""

import os
import pty
import termios
import time
from contextlib import nullcontext

import pytest

from replay.keyboard import Key, Keyboard, keys_in


@pytest.fixture
def terminal():
    """A pseudo-terminal: the end that types, the end that reads."""
    typing, reading = pty.openpty()
    yield typing, reading
    os.close(typing)
    os.close(reading)


def test_what_terminals_send():
    assert keys_in(b" ") == [Key.PAUSE]
    assert keys_in(b"\x1b[C\x1b[A\x1b[B") == [Key.STEP, Key.FASTER, Key.SLOWER]
    assert keys_in(b"\x1bOC") == [Key.STEP]  # application mode
    assert keys_in(b"q\x1b[D\n\x1bABC\xff") == []


def test_keys_come_one_at_a_time_in_order(terminal):
    typing, reading = terminal
    with Keyboard(reading) as keyboard:
        assert keyboard.usable
        os.write(typing, b" x\x1b[C")
        assert [keyboard.press(1.0), keyboard.press(1.0)] == [Key.PAUSE, Key.STEP]
        assert keyboard.press(0.0) is None


def test_a_key_ends_the_wait_and_silence_does_not(terminal):
    typing, reading = terminal
    with Keyboard(reading) as keyboard:
        began_s = time.monotonic()
        assert keyboard.press(0.05) is None
        assert time.monotonic() - began_s >= 0.05
        os.write(typing, b" ")
        began_s = time.monotonic()
        assert keyboard.press(20.0) is Key.PAUSE
        assert time.monotonic() - began_s < 10


@pytest.mark.parametrize("error", [None, RuntimeError, KeyboardInterrupt])
def test_the_terminal_is_restored_whatever_happens(terminal, error):
    _, reading = terminal
    before = termios.tcgetattr(reading)
    with pytest.raises(error) if error is not None else nullcontext(), Keyboard(reading):
        local_flags = termios.tcgetattr(reading)[3]
        assert not local_flags & (termios.ICANON | termios.ECHO)
        assert local_flags & termios.ISIG  # Ctrl-C stays what it is
        if error is not None:
            raise error
    assert termios.tcgetattr(reading) == before


def test_without_a_terminal_there_are_no_keys_and_the_wait_is_the_same():
    reading, writing = os.pipe()
    with Keyboard(reading) as keyboard:
        assert not keyboard.usable
        os.write(writing, b" ")
        began_s = time.monotonic()
        assert keyboard.press(0.05) is None
        assert time.monotonic() - began_s >= 0.05
    assert os.read(reading, 1) == b" "  # it is not ours
    os.close(reading)
    os.close(writing)


def test_a_terminal_that_goes_away_presses_nothing():
    typing, reading = pty.openpty()
    with Keyboard(reading) as keyboard:
        os.close(typing)
        assert keyboard.press(0.01) is None
        assert keyboard.press(0.01) is None
        assert not keyboard.usable
    os.close(reading)
