"""Another taojax in a fresh interpreter; it ends when the one that started it does."""

import contextlib
import os
import runpy
import signal
import subprocess
import sys
import threading
from collections.abc import Sequence

HEARD_S = 5.0
"""So long a child may take to end after an interrupt, before it is told again."""


def start(words: Sequence[str], *, has_own_group: bool = False) -> subprocess.Popen[bytes]:
    """Start a verb in a fresh interpreter.

    The child holds the reading end of a pipe that nobody writes to. Whatever ends this process, be
    it kill -9, closes the other end, and the child ends too.

    Args:
        words: verb and flags.
        has_own_group: a terminal's Ctrl-C does not reach the child.
    """
    command = [sys.executable, "-m", "taojax.verbs.child", *words]
    group = 0 if has_own_group else None
    return subprocess.Popen(command, stdin=subprocess.PIPE, process_group=group)


def run(words: Sequence[str], *, has_own_group: bool = False) -> int:
    """Run a verb in a fresh interpreter to its end and return the exit code.

    Args:
        words: verb and flags.
        has_own_group: a terminal's Ctrl-C reaches the child through this process alone.

    Raises:
        KeyboardInterrupt: after the child has ended too.
    """
    with start(words, has_own_group=has_own_group) as child:
        try:
            return child.wait()
        except KeyboardInterrupt:
            # A terminal tells both; somebody who tells this process alone means both.
            if not has_own_group:
                with contextlib.suppress(subprocess.TimeoutExpired):
                    child.wait(HEARD_S)
            if child.poll() is None:
                child.send_signal(signal.SIGINT)
            # An interrupt may be lost inside an import; a closed pipe is not.
            with contextlib.suppress(subprocess.TimeoutExpired):
                child.wait(HEARD_S)
            if child.stdin is not None:
                child.stdin.close()
            child.wait()
            raise


def _end_with_parent() -> None:
    while os.read(0, 1):
        pass
    os._exit(130)


if __name__ == "__main__":
    threading.Thread(target=_end_with_parent, daemon=True).start()
    runpy.run_module("taojax", run_name="__main__")
