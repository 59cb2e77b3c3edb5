"""A lock between processes: kept for as long as its holder lives."""

import signal
import subprocess
import sys
import threading
import time

from replay.process_lock import held

HOLD = "import sys, time; from pathlib import Path; from replay.process_lock import held\n"
HOLD += "with held(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"


def test_one_after_the_other(tmp_path):
    order = []

    def hold(name):
        with held(tmp_path / "lock"):
            order.append(name)
            time.sleep(0.05)
            order.append(name)

    threads = [threading.Thread(target=hold, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert order in (["a", "a", "b", "b"], ["b", "b", "a", "a"])


def test_a_killed_holder_holds_no_longer(tmp_path):
    with subprocess.Popen([sys.executable, "-c", HOLD, tmp_path / "lock"], stdout=subprocess.PIPE) as holder:
        assert holder.stdout.readline() == b"held\n"
        threading.Timer(0.2, holder.send_signal, [signal.SIGKILL]).start()
        started = time.monotonic()
        with held(tmp_path / "lock"):
            assert time.monotonic() - started > 0.1
            assert holder.wait(10) == -signal.SIGKILL
