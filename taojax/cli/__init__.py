"""Command line. Each verb imports its own room only when it is called.

The flags are plain dataclasses: `--help` answers without importing jax.
"""

import difflib
import importlib
import os
import sys
import traceback
from collections.abc import Sequence

from taojax.errors import (
    ConfigError,
    GateError,
    InputError,
    MissingExtraError,
    TaojaxError,
    UsageError,
)

ABOUT = "Am I lost, or just somewhere new, and may this loop closure enter my graph?"
EXIT_CODES = {UsageError: 2, InputError: 3, ConfigError: 3, MissingExtraError: 4, GateError: 5}
VERBS = {
    "audit": "the main job: score, seal, label, calibrate, measure, report",
    "score": "run time only: seals signals and verdicts; needs no truth",
    "evaluate": "judges a sealed run against the truth",
    "convert": "public data sets and your own recordings as a data folder",
    "describe": "descriptors of thermal or RGB images",
    "inspect": "what a data folder holds, what is wrong, what to expect",
    "simulate": "writes the simulated world as a data folder",
    "kidnap": "carries the robot elsewhere: frames and metres until it is back",
    "sweep": "tries many settings, chooses on the calibration half alone",
    "export": "the step for programs without this package",
    "closures": "accepted and rejected closures as g2o, accepted poses as TUM",
    "graph": "what the closures do to a pose graph, rivals beside",
    "explain": "why a frame was accepted, rejected or left open",
    "view": "map, answers, candidates and verdicts over time for the viewer of Rerun",
    "watch": "verdicts for a running robot: JSON lines in, JSON lines out",
    "compare": "paired differences of judged runs",
    "rerun": "scores a sealed run again and holds it against its seal",
    "doctor": "is this machine set up, and what would make it faster",
    "bench": "how fast step, replay and retrieval are, rivals beside",
}
"""Verb -> what it does. Module and class of the flags have its name."""

RENAMED = {
    "--map-views": "--map-descriptors",
    "--query-views": "--query-descriptors",
    "--simulate-views": "--simulate-descriptors",
    "--no-simulate-views": "--no-simulate-descriptors",
    "--views-order": "--descriptors-order",
    "--truth-poses": "--query-poses",
    "--images": "--frames",
}
"""Earlier spelling of a flag -> the one that all verbs share."""


def renamed(words: Sequence[str]) -> tuple[list[str], list[str]]:
    """Return the words with each flag as it is spelled now, and a line on each that was not."""
    now, lines = [], []
    for word in words:
        name, equals, value = word.partition("=")
        new = RENAMED.get(name.replace("_", "-"))
        now.append(word if new is None else f"{new}{equals}{value}")
        if new is not None:
            lines.append(f"note: {name} is called {new} now")
    return now, lines


def page() -> str:
    """Return what `taojax --help` says."""
    rows = [f"  {verb:10s}{does}" for verb, does in VERBS.items()]
    return "\n".join(
        ["usage: taojax VERB ... [-h]", "", ABOUT, "", *rows, "", "taojax VERB --help says more."]
    )


def _run(words: Sequence[str]) -> None:
    """Run the verb that the first word names."""
    verb, *rest = words or [""]
    if verb in ("-h", "--help"):
        print(page())
        return
    if verb not in VERBS:
        near = difflib.get_close_matches(verb, VERBS, 1)
        what = f"there is no verb {verb!r}" if verb else "name a verb"
        hint = f"perhaps {near[0]!r}; " if near else ""
        raise UsageError(f"{what}; {hint}`taojax --help` lists them")
    import tyro

    from taojax.cli.cache import keep_compiled
    from taojax.cli.common import Compiling

    module = importlib.import_module(f"taojax.cli.{verb}")
    rest, notes = renamed(rest)
    for note in notes:
        _say(note)
    args = tyro.cli(getattr(module, verb.capitalize()), prog=f"taojax {verb}", args=rest)
    if isinstance(args, Compiling) and (why_not := keep_compiled(is_wanted=args.cache)):
        _say(why_not)
    # XLA's notices are not the user's business.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    module.run(args)


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 ok, 1 internal error, 2 usage, 3 bad input, 4 missing extra, 5 slower
        than the baseline or not reproduced, 130 interrupted.
    """
    try:
        _run(sys.argv[1:] if argv is None else argv)
    except TaojaxError as error:
        _say(f"taojax: {error}")
        return next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        _say("taojax: interrupted; what is sealed is kept")
        return 130
    except Exception:
        traceback.print_exc()
        _say("taojax: internal error; please report it with the lines above")
        return 1
    return 0
