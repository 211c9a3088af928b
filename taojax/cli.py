"""Command line. Each verb imports its own room only when it is called.

The flags are plain dataclasses: `--help` answers without importing jax.
"""

import os
import sys
import traceback

import tyro

from taojax.errors import (
    ConfigError,
    GateError,
    InputError,
    MissingExtraError,
    TaojaxError,
    UsageError,
)
from taojax.verbs import (
    audit,
    bench,
    closures,
    compare,
    convert,
    describe,
    doctor,
    evaluate,
    explain,
    export,
    graph,
    inspect,
    kidnap,
    rerun,
    score,
    simulate,
    sweep,
    view,
    watch,
)
from taojax.verbs.common import say

ABOUT = "Am I lost, or just somewhere new, and may this loop closure enter my graph?"
EXIT_CODES = {UsageError: 2, InputError: 3, ConfigError: 3, MissingExtraError: 4, GateError: 5}
Verb = (
    audit.Audit
    | score.Score
    | evaluate.Evaluate
    | convert.Convert
    | describe.Describe
    | inspect.Inspect
    | simulate.Simulate
    | kidnap.Kidnap
    | sweep.Sweep
    | export.Export
    | closures.Closures
    | graph.Graph
    | explain.Explain
    | view.View
    | watch.Watch
    | compare.Compare
    | rerun.Rerun
    | doctor.Doctor
    | bench.Bench
)
RUN = {
    audit.Audit: audit.run,
    score.Score: score.run,
    evaluate.Evaluate: evaluate.run,
    convert.Convert: convert.run,
    describe.Describe: describe.run,
    inspect.Inspect: inspect.run,
    simulate.Simulate: simulate.run,
    kidnap.Kidnap: kidnap.run,
    sweep.Sweep: sweep.run,
    export.Export: export.run,
    closures.Closures: closures.run,
    graph.Graph: graph.run,
    explain.Explain: explain.run,
    view.View: view.run,
    watch.Watch: watch.run,
    compare.Compare: compare.run,
    rerun.Rerun: rerun.run,
    doctor.Doctor: doctor.run,
    bench.Bench: bench.run,
}


def main(argv: list[str] | None = None) -> int:
    """Run one command.

    Returns:
        0 ok, 1 internal error, 2 usage, 3 bad input, 4 missing extra, 5 slower
        than the baseline or not reproduced, 130 interrupted.
    """
    # Matplotlib's cache and XLA's notices are not the user's business.
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "2")
    try:
        args = tyro.cli(Verb, prog="taojax", args=argv, description=ABOUT)
        RUN[type(args)](args)
    except TaojaxError as error:
        say(f"taojax: {error}")
        return next(code for kind, code in EXIT_CODES.items() if isinstance(error, kind))
    except BrokenPipeError:
        # Whoever read the output, such as `head`, has seen enough.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except KeyboardInterrupt:
        say("taojax: interrupted; what is sealed is kept")
        return 130
    except Exception:
        traceback.print_exc()
        say("taojax: internal error; please report it with the lines above")
        return 1
    return 0
