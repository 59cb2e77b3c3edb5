"""Faults injected into short replays at random moments, and what came of each: nothing may be silently wrong.

    python -m benchmarks.faults [--repeats N] [--seed N] [--at-once N]

Every replay is the command, as a process of its own, with an older output under the name of the new one. Forbidden are:
half a file under the final name, an older output that is touched before the new one is whole, an exit code that does
not say what happened, a traceback, a process or a temporary folder that stays. Exits with 1 if anything of that kind
was seen. Linux only: what runs is found in /proc.
"""

import argparse
import contextlib
import json
import os
import random
import resource
import secrets
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

from mcap.reader import make_reader

from replay.log_reader import LogReader
from replay.private_folder import YOUNG_S
from replay.simulator import simulate

DRIVE_S, RATE = 4.0, 4.0  # so the second half of a replay, in which it writes, takes a second
PATIENCE_S = 120.0  # for a replay to end; a predictor that is stopped for good is noticed after 10 s
LEAVING_S = 20.0  # for a spawned predictor to end after its replay
# A shell that runs us in the background has us ignore Ctrl-C, nohup SIGHUP, and what we start inherits that.
HEAR = (
    "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
    "signal.signal(signal.SIGHUP, signal.SIG_DFL)"
)
START = "from replay.__main__ import main; main()"
MARK = "PCGAN_FAULTS_RUN"  # in the environment of a replay, and of all that it starts
OLDER = b"an older output, which stays until the new one is whole"
IDENTICAL, SHORTENED, UNTOUCHED = "identical", "valid up to there", "older output untouched"


class Running:
    """The command in a process of its own, marked so that all it starts can be found; Python code may run before."""

    def __init__(self, folder: Path, *arguments: object, limit_bytes: int | None = None, before: str = ""):
        self.mark = secrets.token_hex(8)
        self.temporary = folder / "tmp"
        self.temporary.mkdir(exist_ok=True)
        self._said = tempfile.TemporaryFile("w+", dir=folder)  # noqa: SIM115  read and closed in `wait`
        self.process = subprocess.Popen(
            [sys.executable, "-c", f"{HEAR}\n{before}\n{START}", *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            stdout=self._said,
            stderr=self._said,
            start_new_session=True,
            env={**os.environ, "OMP_NUM_THREADS": "1", "TMPDIR": str(self.temporary), MARK: self.mark},
        )
        if limit_bytes is not None:
            resource.prlimit(self.process.pid, resource.RLIMIT_FSIZE, (limit_bytes, limit_bytes))
        self.pid = self.process.pid

    @property
    def ended(self) -> bool:
        """True once the process has ended."""
        return self.process.poll() is not None

    def predictors(self) -> list[int]:
        """Returns the process ids of what it has spawned and still runs."""
        return [pid for pid in marked(self.mark) if pid != self.pid]

    def predictor(self) -> int | None:
        """Waits for a spawned predictor; None if the replay ends before there is one."""
        while not self.ended:
            if found := self.predictors():
                return found[0]
            time.sleep(0.002)
        return None

    def wait(self) -> tuple[int, str]:
        """Waits for the end; returns exit code and all that was said."""
        try:
            code = self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()
            code = -999
        self._said.seek(0)
        said = self._said.read()
        self._said.close()
        return code, said

    def end(self) -> None:
        """Kills it and all it has started, whatever they are doing."""
        while (living := marked(self.mark)) or not self.ended:
            for pid in living:
                send(pid, signal.SIGKILL)
            time.sleep(0.01)
        self._said.close()

    def left_over(self) -> list[str]:
        """Waits for what it has spawned to end too; returns processes that do not, and temporary files that stay."""
        deadline = time.monotonic() + LEAVING_S
        while (living := self.predictors()) and time.monotonic() < deadline:
            time.sleep(0.02)
        for pid in living:
            send(pid, signal.SIGKILL)
        if any(self.temporary.iterdir()):
            self._start_another()
        return [
            *(f"process {pid} still runs" for pid in living),
            *(f"{p.name} stays" for p in self.temporary.iterdir()),
        ]

    def _start_another(self) -> None:
        """Does what the next replay begins with, a minute later: what a replay and its predictor, killed both, left."""
        then = time.time() - YOUNG_S - 1
        for path in self.temporary.iterdir():
            os.utime(path, (then, then))
        code = "from replay.private_folder import PrivateFolder; PrivateFolder().remove()"
        subprocess.run([sys.executable, "-c", code], env={**os.environ, "TMPDIR": str(self.temporary)}, check=True)


def marked(mark: str) -> list[int]:
    """Returns the ids of running processes with a mark in their environment."""
    entry, found = f"{MARK}={mark}".encode(), []
    for folder in Path("/proc").iterdir():
        if folder.name.isdigit():
            with contextlib.suppress(OSError):
                if entry in (folder / "environ").read_bytes().split(b"\0"):
                    found.append(int(folder.name))
    return found


def send(pid: int, signum: int) -> bool:
    """Sends a signal; False if the process has gone."""
    try:
        os.kill(pid, signum)
    except ProcessLookupError:
        return False
    return True


class Link:
    """A TCP link through this process, which can be cut, stalled and restored."""

    def __init__(self, port: int):
        self._to = port
        self._lock = threading.Lock()
        self._pairs: dict[socket.socket, socket.socket] = {}
        self._cut, self._stalled, self._closed = False, False, False
        self.connections = 0
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def cut(self) -> None:
        """Ends all connections, and every new one at once."""
        with self._lock:
            self._cut = True
            for one in self._pairs:
                with contextlib.suppress(OSError):
                    one.shutdown(socket.SHUT_RDWR)

    def stall(self) -> None:
        """Keeps connections open, takes new ones, and forwards nothing."""
        self._stalled = True

    def restore(self) -> None:
        """Lets everything through again."""
        self._cut = self._stalled = False

    def close(self) -> None:
        """Ends the link for good."""
        self._closed = True
        self.cut()
        self._thread.join(10)
        self._listener.close()

    def _run(self) -> None:
        while not self._closed:
            waiting = [self._listener, *([] if self._stalled else self._pairs)]
            for ready in select.select(waiting, [], [], 0.01)[0]:
                if ready is self._listener:
                    self._accept()
                elif ready in self._pairs:
                    self._forward(ready)
        for one in list(self._pairs):
            self._drop(one)

    def _accept(self) -> None:
        near, _ = self._listener.accept()
        if self._cut:
            near.close()
            return
        try:
            far = socket.create_connection(("127.0.0.1", self._to), 5)
        except OSError:
            near.close()
            return
        with self._lock:
            self._pairs |= {near: far, far: near}
        self.connections += 1

    def _forward(self, source: socket.socket) -> None:
        try:
            data = source.recv(1 << 16)
            if data:
                self._pairs[source].sendall(data)
                return
        except OSError:
            pass
        self._drop(source)

    def _drop(self, one: socket.socket) -> None:
        with self._lock:
            other = self._pairs.pop(one, None)
            if other is not None:
                self._pairs.pop(other, None)
        for each in (one, other):
            if each is not None:
                each.close()


@dataclass
class Scene:
    """What every replay needs: a drive, its undisturbed output, how long it takes to start, a predictor that runs."""

    folder: Path
    drive: Path
    reference: bytes
    messages: list[tuple[str, int, bytes]]
    startup_s: float
    port: int

    def replay(self, folder: Path, *options: object, limit_bytes: int | None = None) -> Running:
        """Starts a replay into a folder where an older output lies."""
        (folder / "out.mcap").write_bytes(OLDER)
        arguments = ("replay", self.drive, "-o", folder / "out.mcap", "--rate", RATE)
        return Running(folder, *arguments, *options, limit_bytes=limit_bytes)

    def wait(self, running: Running, folder: Path, chance: random.Random) -> None:
        """Waits for a random moment: while the replay starts, or from its first frame to a little after its end."""
        if chance.random() < 0.35:
            time.sleep(chance.uniform(0, self.startup_s))
            return
        while not running.ended and not (folder / "out.mcap.part").exists():
            time.sleep(0.002)
        time.sleep(chance.uniform(0, DRIVE_S / RATE + 0.4))


@dataclass
class Outcome:
    """What came of a fault."""

    fault: str
    what: str  # IDENTICAL, SHORTENED or UNTOUCHED
    notes: list[str] = field(default_factory=list)  # a part left, an error line, a fault that came too late
    forbidden: list[str] = field(default_factory=list)


@contextlib.contextmanager
def scene(folder: Path) -> Iterator[Scene]:
    """Makes a scene; its predictor serves external replays until the end."""
    drive, port = folder / "drive.mcap", free_port()
    simulate(drive, clip=None, vehicle=None, pedestrians=6, duration_s=DRIVE_S, seed=5)
    began = time.monotonic()
    (folder / "whole").mkdir()
    undisturbed = Running(folder / "whole", "replay", drive, "-o", folder / "whole" / "out.mcap", "--rate", RATE)
    code, said = undisturbed.wait()
    if code:
        raise SystemExit(f"the undisturbed replay failed with {code}: {said}")
    startup_s = time.monotonic() - began - DRIVE_S / RATE
    predictor = Running(folder, "predict", "--listen", f"tcp/127.0.0.1:{port}")
    try:
        while not listens(port):
            if predictor.ended:
                raise SystemExit(f"the predictor failed: {predictor.wait()}")
            time.sleep(0.05)
        output = folder / "whole" / "out.mcap"
        yield Scene(folder, drive, output.read_bytes(), messages_of(output), startup_s, port)
    finally:
        predictor.process.terminate()
        predictor.wait()


def free_port() -> int:
    """Returns a port of the loopback that nobody has."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    """Tells whether somebody listens on a port of the loopback."""
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


def messages_of(path: Path) -> list[tuple[str, int, bytes]]:
    """Returns what lies in a complete MCAP file, all CRCs checked by mcap's own reader."""
    with path.open("rb") as stream:
        rows = make_reader(stream, validate_crcs=True).iter_messages()
        return [(channel.topic, message.log_time, message.data) for _, channel, message in rows]


# --- faults: each starts a replay, injects itself at a moment, and returns the exit codes that may follow -------------

Injection = Callable[[Scene, Path, random.Random], tuple[Running, set[int], list[str]]]


def kill_predictor(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
    """SIGKILL to the predictor: start-up, first frame, middle, end."""
    running = now.replay(folder)
    now.wait(running, folder, chance)
    pid = running.predictor()
    return running, {0}, [] if pid and send(pid, signal.SIGKILL) else ["too late"]


def kill_predictors(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
    """SIGKILL to the predictor and to those that replace it, three at most, young or not: still nothing is lost."""
    running = now.replay(folder)
    now.wait(running, folder, chance)
    killed: set[int] = set()
    for _ in range(chance.randint(2, 3)):
        time.sleep(chance.choice([0.0, 0.3, 1.5]))
        pid = running.predictor()
        if pid is not None and pid not in killed and send(pid, signal.SIGKILL):
            killed.add(pid)
    return running, {0}, [f"{len(killed)} killed"]


def stop_predictor(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
    """SIGSTOP to the predictor, for a while or for good."""
    running = now.replay(folder)
    now.wait(running, folder, chance)
    pid = running.predictor()
    stopped = pid is not None and send(pid, signal.SIGSTOP)
    if pid is not None and chance.random() < 0.8:
        time.sleep(chance.uniform(0.1, 2.0))
        send(pid, signal.SIGCONT)
    return running, {0}, [] if stopped else ["too late"]


def kill_replay(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
    """SIGKILL to the replay."""
    running = now.replay(folder)
    now.wait(running, folder, chance)
    running.process.kill()
    return running, {0, -signal.SIGKILL}, []


def kill_both(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
    """SIGKILL to the predictor and, a moment later, to the replay."""
    running = now.replay(folder)
    now.wait(running, folder, chance)
    for pid in running.predictors():
        send(pid, signal.SIGKILL)
    time.sleep(chance.choice([0.0, 0.05, 0.5]))
    running.process.kill()
    return running, {0, -signal.SIGKILL}, []


def signalled(signum: int, times: int = 1) -> Injection:
    """Returns a fault: a signal to the replay, several times if somebody is impatient."""

    def inject(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
        running = now.replay(folder)
        now.wait(running, folder, chance)
        for _ in range(times):
            running.process.send_signal(signum)
            time.sleep(chance.choice([0.0, 0.002, 0.2]))
        return running, {0, 128 + signum, -signum}, []

    return inject


def fill_disk(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
    """A limit on the size of files, met anywhere from the first byte to the last."""
    limit = chance.randint(1, len(now.reference) - 1)
    return now.replay(folder, "--predictor", "inline", limit_bytes=limit), {2}, []


def disturb_link(how: str) -> Injection:
    """Returns a fault: the link to an external predictor is cut or stalled, and restored."""

    def inject(now: Scene, folder: Path, chance: random.Random) -> tuple[Running, set[int], list[str]]:
        link = Link(now.port)
        running = now.replay(folder, "--predictor", "external", "--connect", link.endpoint)
        now.wait(running, folder, chance)
        for _ in range(chance.randint(1, 2)):
            link.cut() if how == "cut" else link.stall()
            time.sleep(chance.uniform(0.0, 2.0))
            link.restore()
            time.sleep(chance.uniform(0.0, 0.3))
        running.process.wait(PATIENCE_S)
        link.close()
        return running, {0}, [] if link.connections else ["never connected"]

    return inject


FAULTS: dict[str, Injection] = {
    "kill -9 predictor": kill_predictor,
    "kill -9 predictors in a row": kill_predictors,
    "SIGSTOP predictor": stop_predictor,
    "kill -9 replay": kill_replay,
    "kill -9 both": kill_both,
    "SIGTERM": signalled(signal.SIGTERM),
    "SIGINT": signalled(signal.SIGINT),
    "SIGINT twice": signalled(signal.SIGINT, 2),
    "SIGHUP": signalled(signal.SIGHUP),
    "disk full": fill_disk,
    "link cut": disturb_link("cut"),
    "link stalled": disturb_link("stall"),
}


def inject(now: Scene, fault: str, number: int, seed: int) -> Outcome:
    """Injects one fault at a random moment, and says what came of it."""
    chance = random.Random(f"{seed}/{number}/{fault}")
    folder = now.folder / f"{number:04}"
    folder.mkdir()
    running, codes, notes = FAULTS[fault](now, folder, chance)
    code, said = running.wait()
    return judged(now, fault, folder, running, (code, said), codes, notes)


def judged(
    now: Scene, fault: str, folder: Path, running: Running, end: tuple[int, str], codes: set[int], notes: list[str]
) -> Outcome:
    """Says what a replay left behind, and what of that is forbidden."""
    code, said = end
    forbidden = running.left_over()
    if code not in codes:
        forbidden.append(f"exit code {code}: {said[-300:]!r}")
    if "Traceback" in said or "Exception ignored" in said:
        forbidden.append(f"traceback: {said[-1500:]}")
    what, problem = found_under_final_name(now, folder / "out.mcap")
    if problem:
        forbidden.append(problem)
    if code == 0 and what != IDENTICAL:
        forbidden.append(f"exit code 0, and the output is {what}")
    if code == 2 and len([line for line in said.splitlines() if line.startswith("pcgan: ")]) != (what != SHORTENED):
        forbidden.append(f"not one line: {said!r}")
    part = folder / "out.mcap.part"
    if part.exists():
        notes = [*notes, "part left"]
        forbidden += problems_of_part(now, part)
    if strange := {path.name for path in folder.iterdir()} - {"out.mcap", "out.mcap.part", "tmp"}:
        forbidden.append(f"left over: {strange}")
    return Outcome(fault, what, [*notes, *(["exit code 2"] if code == 2 else [])], forbidden)


def found_under_final_name(now: Scene, output: Path) -> tuple[str, str]:
    """Returns what lies under the final name, and what is wrong with it."""
    data = output.read_bytes() if output.exists() else b""
    if data == now.reference:
        return IDENTICAL, ""
    if data == OLDER:
        return UNTOUCHED, ""
    try:
        messages = messages_of(output)
        with output.open("rb") as stream:
            metadata = {record.name: record.metadata for record in make_reader(stream).iter_metadata()}
    except Exception as error:  # what mcap raises on damage has no common base
        return "half a file", f"half a file under the final name: {error!r}"
    if messages != now.messages[: len(messages)] or len(messages) % 4:
        return "a wrong file", f"{len(messages)} messages under the final name are not the first ones"
    if json.loads(metadata["pcgan"]["complete"]) != (len(messages) == len(now.messages)):
        return SHORTENED, f"{len(messages)} messages, complete: {metadata['pcgan']['complete']}"
    return SHORTENED, ""


def problems_of_part(now: Scene, part: Path) -> list[str]:
    """Returns what is wrong with a part: what --salvage reads of it must be what was written first."""
    try:
        messages = [(m.topic, m.log_time_ns, m.data) for m in LogReader([part], salvage=True).messages()]
    except Exception as error:
        return [] if "holds no messages" in str(error) else [f"the part cannot be salvaged: {error!r}"]
    return [] if messages == now.messages[: len(messages)] else ["the part holds other messages"]


def run(repeats: int, seed: int, at_once: int = 1, kinds: Sequence[str] = tuple(FAULTS)) -> list[Outcome]:
    """Injects every kind of fault so many times; returns what came of each."""
    jobs = [kind for _ in range(repeats) for kind in kinds]
    with (
        tempfile.TemporaryDirectory(prefix="faults-") as folder,
        scene(Path(folder)) as now,
        ThreadPoolExecutor(at_once) as pool,
    ):
        return list(pool.map(lambda job: inject(now, job[1], job[0], seed), enumerate(jobs)))


def report(outcomes: Sequence[Outcome]) -> str:
    """Returns a table of faults by outcome, and all that is forbidden."""
    columns = [IDENTICAL, SHORTENED, UNTOUCHED]
    lines = [f"{'fault':28}{'injected':>9}" + "".join(f"{column:>24}" for column in columns) + "   of these"]
    for fault in FAULTS:
        mine = [outcome for outcome in outcomes if outcome.fault == fault]
        if not mine:
            continue
        counts = Counter(outcome.what for outcome in mine)
        notes = Counter(note for outcome in mine for note in outcome.notes)
        told = ", ".join(f"{count} {note}" for note, count in sorted(notes.items()))
        lines.append(f"{fault:28}{len(mine):9}" + "".join(f"{counts[column]:24}" for column in columns) + f"   {told}")
    wrong = [(outcome.fault, problem) for outcome in outcomes for problem in outcome.forbidden]
    lines.append(f"{len(outcomes)} faults, {len(wrong)} forbidden outcomes")
    return "\n".join([*lines, *(f"FORBIDDEN after {fault}: {problem}" for fault, problem in wrong)])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5, help="of every kind of fault")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--at-once", type=int, default=1, help="replays that run at a time")
    parser.add_argument("--only", action="append", choices=list(FAULTS), help="these kinds only")
    options = parser.parse_args()
    outcomes = run(options.repeats, options.seed, options.at_once, options.only or list(FAULTS))
    print(report(outcomes))
    raise SystemExit(any(outcome.forbidden for outcome in outcomes))


if __name__ == "__main__":
    main()
