"""Other taojaxes in fresh interpreters; they end when the one that started them does."""

import contextlib
import json
import os
import queue
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence
from typing import NamedTuple

HEARD_S = 5.0
"""So long children may take to end after an interrupt."""


class Child(NamedTuple):
    """An interpreter that runs one verb after another: what it has compiled serves them all."""

    process: subprocess.Popen[bytes]
    codes: int
    """Pipe that brings an exit code, one byte, for each verb that is done."""

    def give(self, words: Sequence[str]) -> None:
        """Have it run a verb."""
        assert self.process.stdin is not None  # noqa: S101 - see `start`
        # One that has died says so through its other pipe.
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.write(json.dumps(list(words)).encode() + b"\n")
            self.process.stdin.flush()

    def close(self) -> None:
        """Let it end."""
        assert self.process.stdin is not None  # noqa: S101 - see `start`
        with contextlib.suppress(BrokenPipeError):
            self.process.stdin.close()


def start() -> Child:
    """Start a fresh interpreter, idle.

    The child reads from a pipe. Whatever ends this process, be it kill -9, closes the other end,
    and the child ends too. A terminal's Ctrl-C does not reach it: it hears of an interrupt once,
    from here, and says nothing.
    """
    codes, its_end = os.pipe()
    command = [sys.executable, "-m", "taojax.cli.child", str(its_end)]
    try:
        process = subprocess.Popen(
            command, stdin=subprocess.PIPE, process_group=0, pass_fds=(its_end,)
        )
    finally:
        os.close(its_end)
    return Child(process, codes)


def run(commands: Iterable[Sequence[str]], most: int = 1) -> int:
    """Run verbs in fresh interpreters; after a failure none is begun and the others end.

    Args:
        commands: verb and flags of each; asked for when its turn has come.
        most: interpreters side by side, each for as many verbs as it has time for.

    Returns:
        Exit code of the first that failed, negative = ended by that signal; 0 = all went well.

    Raises:
        KeyboardInterrupt: after all have ended.
    """
    waiting, idle, at_work = iter(commands), list[Child](), list[Child]()
    try:
        while True:
            while len(at_work) < most and (words := next(waiting, None)) is not None:
                at_work.append(idle.pop() if idle else start())
                at_work[-1].give(words)
            if not at_work:
                return 0
            for codes in select.select([child.codes for child in at_work], [], [])[0]:
                child = next(child for child in at_work if child.codes == codes)
                if not (code := os.read(codes, 1)):
                    return child.process.wait() or 1
                if code[0]:
                    return code[0]
                at_work.remove(child)
                idle.append(child)
    finally:
        _end([*at_work, *idle])


def _end(children: Sequence[Child]) -> None:
    for child in children:
        child.process.send_signal(signal.SIGINT)
    for child in children:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.process.wait(HEARD_S)
        # An interrupt may be lost inside an import; a closed pipe is not.
        child.close()
        child.process.wait()
        os.close(child.codes)


def _hear(given: "queue.SimpleQueue[list[str]]") -> None:
    for line in sys.stdin:
        given.put(json.loads(line))
    os._exit(130)


class _Interrupted(SystemExit):
    """Whoever started this says what an interrupt leaves behind."""


def _end_silently(*_: object) -> None:
    # A file that the interrupt leaves half made would complain when it is collected.
    sys.unraisablehook = lambda _: None
    raise _Interrupted(130)


def _code_of(words: list[str]) -> int:
    from taojax.cli import main

    try:
        return main(words)
    except _Interrupted:
        raise
    except SystemExit as left:  # the parser of flags exits by itself
        return left.code if isinstance(left.code, int) else int(left.code is not None)


def _work(codes: int) -> None:
    """Run what is given, one verb after another, until nothing more can come."""
    given = queue.SimpleQueue[list[str]]()
    threading.Thread(target=_hear, args=(given,), daemon=True).start()
    while True:
        code = _code_of(given.get())
        sys.stdout.flush()
        os.write(codes, bytes([code]))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, _end_silently)
    _work(int(sys.argv[1]))
