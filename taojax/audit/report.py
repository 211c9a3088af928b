"""The report of one run, and the summary over several."""

import dataclasses
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from taojax.audit import figures, protocol, summary_text, tables
from taojax.audit.figures import Picture
from taojax.audit.frame_explorer import route_json
from taojax.audit.html import (
    Grid,
    Opening,
    Page,
    glossary,
    grid,
    names_of_signals,
    names_of_tables,
    render,
)
from taojax.audit.judgement import Evaluation, Judgement
from taojax.audit.opening import draw_opening, numbers, sentence, summary_sentence
from taojax.audit.summary_text import (
    MAIN,
    VERDICT_FAR,
    alarms,
    all_alarms,
    counts_table,
    metric_row,
    rate,
    rates_of,
    rates_table,
)
from taojax.files.specs import read_npz, write_atomically

_ALL_FRAMES = ("signal", "n_in", "n_out", "prevalence", "auroc", "aupr_out", "aupr_in", "far_at_95")
_TEST = (
    "signal", "n_in_test", "n_out_test", "prevalence_test", "auroc_test", "aupr_out_test",
    "aupr_in_test", "far_at_95_test",
)  # fmt: skip
SIMULATED = ("The world is simulated; nothing here was measured on the paper's recording.",)
"""What the built-in world must say of itself."""

_NOT_OURS = "Columns paper_* are the paper's figures on its own recording, not ours."
_RATES = (
    "The verdicts may abstain; a signal at its threshold may not. So that signals and rivals can "
    "be compared, every FAR and FRR in the tables further down is one at the threshold."
)
_FROZEN = ("signal", "threshold", "far", "frr", "delay_frames", "n_exits", "n_censored")


def _opening(done: Evaluation, name: str = "") -> Opening:
    href = f"{name}/report.html" if name else ""
    return Opening(draw_opening(done.judgement), numbers(done.judgement), name, href)


def _facts(done: Evaluation) -> dict[str, str]:
    """Return the seal and everything that is needed to repeat the run."""
    manifest, audit = done.judgement.manifest, done.judgement.config.audit
    facts = {"seal": str(manifest["seal"])}
    for key in ("command", "dataset", "device", "seed", "code"):
        if key in manifest:
            facts[key] = str(manifest[key])
    for key in ("versions", "sha256"):
        pairs = manifest.get(key)
        if isinstance(pairs, dict):
            facts[key] = "; ".join(f"{name} {value}" for name, value in sorted(pairs.items()))
    facts["judged by"] = done.command
    config = done.judgement.config
    settings = {field.name: getattr(audit, field.name) for field in dataclasses.fields(audit)}
    settings |= {"gap_frames": config.stream.window, "seed": config.seed}
    facts["judge's settings"] = "; ".join(f"{name} = {v}" for name, v in settings.items())
    return facts


def _notes(judgement: Judgement) -> list[str]:
    notes = judgement.manifest.get("notes", [])
    return [notes] if isinstance(notes, str) else [str(note) for note in notes]


def _micro_grids(micro: tables.Table) -> list[Grid]:
    """Return the strict labels' table, one grid per radius."""
    grids = []
    for radius in np.unique(micro["radius_m"]):
        part = {name: values[micro["radius_m"] == radius] for name, values in micro.items()}
        title = f"Micro-scale audit: strictly within {radius:g} m"
        columns = ("signal", "n_in", "n_out", "auroc")
        found = grid("micro", part, title=title, columns=columns)
        grids.append(found._replace(main=figures.STRICT))
    return grids


def _main(title: str, table: tables.Table, columns: Sequence[str]) -> Grid:
    return grid("metrics", table, title=title, columns=columns)._replace(main=MAIN)


def _first_grids(judgement: Judgement) -> list[Grid]:
    """Return what the sentences count, so that they can be reconciled."""
    audit = judgement.config.audit
    where = (
        f"In the map: truth within {audit.r_in_m:g} m of a map pose; off the map: beyond "
        f"{audit.r_out_m:g} m; grey: between. The threshold is that of the probability."
    )
    return [
        grid("counts", counts_table(judgement), title="Every frame, once", note=where),
        grid(
            "rates", rates_table(judgement), title="What each rate counts", note=_RATES,
            columns=("rate", "counted", "among", "n", "n_of", "value"),
        )._replace(is_half=True),
    ]  # fmt: skip


def _run_grids(judgement: Judgement) -> list[Grid]:
    table = judgement.metrics
    is_fitted = np.isin(table["signal"].astype(str), tables.PROBABILITIES)
    runtime = {name: values[~is_fitted] for name, values in table.items()}
    probability = {name: values[is_fitted] for name, values in table.items()}
    scores = ("signal", "n_in_test", "n_out_test", "ece", "brier")
    conformal = grid("conformal", judgement.conformal, title="Promised false acceptance rate")
    return [
        grid("errors", judgement.errors, title="Localisation error of in-map frames"),
        grid("recall", judgement.recall, title="Answerability and recall over all queries"),
        _main("At the frozen threshold, on the test split", table, _FROZEN),
        _main("Separation over all labelled frames", runtime, _ALL_FRAMES),
        _main("Separation on the test split", table, _TEST),
        conformal._replace(main=MAIN),
        *_micro_grids(judgement.micro),
        grid("metrics", probability, title="Calibrated probabilities", columns=scores),
    ]


def _terms() -> dict[str, Mapping[str, str]]:
    """Return the definitions of all names in tables, figures and the frame panel, by section."""
    tables_here = ("counts", "rates", "errors", "recall", "metrics", "conformal", "micro")
    # Reasons name the features of answers.
    named = names_of_tables((*tables_here, "delayed"))
    return {"Signals": names_of_signals(), "Columns of the tables": named}


def run_page(done: Evaluation, pictures: Sequence[Picture]) -> str:
    """Return the report of one run as one HTML file."""
    judgement = done.judgement
    audit = judgement.config.audit
    dataset = judgement.manifest.get("dataset", done.run)
    lead, warned = (sentence(judgement),), alarms(done)
    # Its hash was checked before the judge began.
    found = read_npz(done.run / "retrievals.npz", "retrievals")
    return render(
        Page(
            title=f"May these answers enter the graph? {Path(str(dataset)).name}",
            subtitle=(
                f"{len(judgement.label)} queries against {len(judgement.map_m)} map poses; in-map "
                f"within {audit.r_in_m:g} m, map-out beyond {audit.r_out_m:g} m. "
                f"Seal {str(judgement.manifest['seal'])[:16]}…"
            ),
            notes=_notes(judgement),
            lead=lead,
            openings=[_opening(done)],
            headline=[said for said in done.sentences if said not in (*lead, *warned)],
            grids=[*_first_grids(judgement), *_run_grids(judgement)],
            # The page opens with the map; in the folder it stands beside the other figures.
            pictures=[drawn for drawn in pictures if drawn.name != "map"],
            facts=_facts(done),
            command=done.command,
            words=glossary(),
            terms=_terms(),
            warnings=warned,
            route=route_json(judgement, found["index"], found["similarity"]),
        )
    )


def _summary_words(scenarios: Mapping[str, Evaluation], base: Evaluation) -> list[str]:
    said = []
    for name, done in summary_text.cut_maps(scenarios).items():
        said += [f"{name}: {told}" for told in done.graph]
        tao, top1 = (metric_row(done.judgement, s) for s in ("tao", "top1"))
        far = rates_of(done.judgement)[VERDICT_FAR]
        said.append(
            f"{name}: {int(tao['n_out'])} of {len(done.judgement.label)} queries are off the map. "
            f"AUROC: tao {rate(tao, 'auroc')}, best similarity {rate(top1, 'auroc')}. Of "
            f"{int(tao['n_out_test'])} map-out test frames the verdicts accepted the share "
            f"{rate(far, 'value')}, the best similarity at its threshold {rate(top1, 'far')}."
        )
    micro = base.judgement.micro
    for radius in np.unique(micro["radius_m"]):
        here = micro["radius_m"] == radius
        n_in, n_out = int(micro["n_in"][here][0]), int(micro["n_out"][here][0])
        if n_in and n_out:
            value = dict(zip(micro["signal"][here], micro["auroc"][here], strict=True))
            said.append(
                f"At {radius:g} m ({n_in} in, {n_out} out) the AUROC of the best similarity is "
                f"{value['top1']:.3f}, of C_geom {value['c_geom']:.3f}, of tao {value['tao']:.3f} "
                "(the paper, at 5 m: .543, SVD diagnostics .567)."
            )
        else:
            which = "within" if n_in else "beyond"
            said.append(
                f"At {radius:g} m every query of the uncut map is {which} the radius: one class, "
                "so there is no AUROC."
            )
    return said


def _mapout_columns(key: str) -> tuple[str, ...]:
    measured = (f"top1_{key}", f"paper_top1_{key}", f"velocity_{key}", f"paper_tao_{key}")
    ours = (f"tao_rank_{key}", f"tao_{key}", *(["fused_far"] if key == "far" else []))
    return ("scenario", "map_out_frames", *measured, *ours)


def _frozen_grids(frozen: tables.Table) -> list[Grid]:
    """Return one frozen set beside each scenario's own; nothing where both are one."""
    if not len(frozen["signal"]):
        return []
    columns = (
        "scenario", "signal", "threshold", "far", "frr", "once_on", "once_threshold", "once_far",
        "once_frr", "paper_far",
    )  # fmt: skip
    title = "Per scenario (far, frr) and one frozen set, as in the paper (once_*)"
    return [grid("frozen", frozen, title=title, note=_NOT_OURS, columns=columns)]


def write_summary(
    out: Path,
    scenarios: Mapping[str, Evaluation],
    *,
    command: str = "taojax audit",
    notes: Sequence[str] = SIMULATED,
) -> tuple[str, ...]:
    """Write tables, figures and one page over all scenarios on top of their folders.

    Args:
        out: the folder that holds one run per scenario.
        scenarios: name -> judged run; `full` is the map that was not cut.
        command: what the user ran.
        notes: printed on top; those of the runs are folded.

    Returns:
        What was found, in plain sentences.

    Raises:
        InputError: a file cannot be written.
    """
    base = scenarios.get(summary_text.WHOLE, next(iter(scenarios.values())))
    frozen = protocol.frozen_table(scenarios)
    words = (*_summary_words(scenarios, base), *protocol.frozen_words(frozen))
    mapout, recall, micro = (
        summary_text.mapout_table(scenarios), base.judgement.recall, base.judgement.micro,
    )  # fmt: skip
    pictures = (figures.retrieval(base.judgement), *figures.strict(base.judgement))
    if cut := summary_text.cut_maps(scenarios):
        pictures = (summary_text.compare(scenarios), figures.traces(cut), *pictures)
    said = {note for done in scenarios.values() for note in _notes(done.judgement)}
    others, warned = sorted(said - set(notes)), all_alarms(scenarios)
    seals = {name: str(done.judgement.manifest["seal"]) for name, done in scenarios.items()}
    manifest = {"schema": 1, "command": command, "notes": [*notes, *others], "scenarios": seals}
    page = Page(
        title="May these answers enter the graph? Summary over scenarios",
        subtitle=" ".join([*notes, f"{len(scenarios)} scenarios, each sealed, then judged."]),
        notes=others,
        lead=(summary_sentence({name: done.judgement for name, done in scenarios.items()}),),
        openings=[_opening(done, name) for name, done in scenarios.items()],
        headline=[told for told in words if told not in warned],
        words=glossary(),
        terms={
            "Signals": names_of_signals(),
            "Columns of the tables": names_of_tables(("mapout", "frozen", "recall", "micro")),
        },
        grids=[
            grid("mapout", mapout, title="Map-out scenarios beside the paper's Table 2: AUROC",
                 note=_NOT_OURS, columns=_mapout_columns("auroc")),
            grid("mapout", mapout, title="Map-out scenarios beside the paper's Table 2: FAR",
                 note=_NOT_OURS, columns=_mapout_columns("far")),
            *_frozen_grids(frozen),
            grid("recall", recall, title="Answerability and recall, map not cut"),
            grid("recall", summary_text.paper_recall_table(), title="The paper's Table 1",
                 note="Printed for comparison.")._replace(source="the paper"),
            *_micro_grids(micro),
        ],
        pictures=pictures,
        facts={f"seal of {name}": seal for name, seal in seals.items()} | {"command": command},
        command=command,
        warnings=warned,
    )  # fmt: skip
    files: dict[str, str | bytes] = {
        "metrics.csv": summary_text.joined_metrics(scenarios),
        "report.html": render(page),
        "manifest.json": json.dumps(manifest, indent=2) + "\n",
    }
    for name, table in (
        ("mapout", mapout), ("frozen", frozen), ("recall", recall), ("micro", micro),
    ):  # fmt: skip
        files |= tables.as_files(name, table)
    # The page opens with the maps; in the folder they stand beside the other figures.
    for drawn in (summary_text.maps(scenarios), *pictures):
        files |= figures.as_files(drawn)
    for name, content in files.items():
        write_atomically(out / name, content)
    return words
