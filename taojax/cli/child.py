"""Other taojaxes in fresh interpreters; they end when the one that started them does."""

import contextlib
import os
import runpy
import signal
import subprocess
import sys
import threading
from collections.abc import Iterable, Sequence

HEARD_S = 5.0
"""So long children may take to end after an interrupt."""

GLANCE_S = 0.05
"""Between two looks at who is done."""


def start(words: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a verb in a fresh interpreter.

    The child holds the reading end of a pipe that nobody writes to. Whatever ends this process, be
    it kill -9, closes the other end, and the child ends too. A terminal's Ctrl-C does not reach it:
    it hears of an interrupt once, from here, and says nothing.

    Args:
        words: verb and flags.
    """
    command = [sys.executable, "-m", "taojax.cli.child", *words]
    return subprocess.Popen(command, stdin=subprocess.PIPE, process_group=0)


def run(commands: Iterable[Sequence[str]], most: int = 1) -> int:
    """Run verbs in fresh interpreters; after a failure none is begun and the others end.

    Args:
        commands: verb and flags of each; asked for when its turn has come.
        most: side by side.

    Returns:
        Exit code of the first that failed, negative = ended by that signal; 0 = all went well.

    Raises:
        KeyboardInterrupt: after all have ended.
    """
    waiting, at_work = iter(commands), list[subprocess.Popen[bytes]]()
    try:
        while True:
            while len(at_work) < most and (words := next(waiting, None)) is not None:
                at_work.append(start(words))
            if not at_work:
                return 0
            with contextlib.suppress(subprocess.TimeoutExpired):
                at_work[0].wait(GLANCE_S)
            for child in [child for child in at_work if child.poll() is not None]:
                at_work.remove(child)
                _close(child)
                if child.returncode:
                    return child.returncode
    finally:
        _end(at_work)


def _end(children: Sequence[subprocess.Popen[bytes]]) -> None:
    for child in children:
        child.send_signal(signal.SIGINT)
    for child in children:
        with contextlib.suppress(subprocess.TimeoutExpired):
            child.wait(HEARD_S)
        # An interrupt may be lost inside an import; a closed pipe is not.
        _close(child)
        child.wait()


def _close(child: subprocess.Popen[bytes]) -> None:
    if child.stdin is not None:
        child.stdin.close()


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(130)


def _end_silently(*_: object) -> None:
    # Whoever started this says what an interrupt leaves behind.
    raise SystemExit(130)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, _end_silently)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    runpy.run_module("taojax", run_name="__main__")
