"""Judged runs side by side: paired intervals, honest words, and nothing compared that differs."""

import json
import re
import shutil
from pathlib import Path

import judged
import numpy as np
import pytest
from sklearn.metrics import roc_auc_score

from taojax.audit import compare, figures, report, tables
from taojax.audit import metrics as bootstrap
from taojax.audit.evaluate import evaluate
from taojax.cli import main
from taojax.config import replace
from taojax.errors import InputError
from taojax.files import records
from taojax.files.tables import read_table


def reseal(run, out, config=None, manifest=None, **changes):
    """Seal a run again with other signals or settings."""
    old = records.read_run(run)
    records.write_run(
        out,
        signals=old.signals | changes,
        delayed=old.delayed,
        map_poses=old.map_poses,
        index=old.index,
        similarity=old.similarity,
        config_toml=config or old.config_toml,
        manifest={"notes": [], "sha256": {}} | (manifest or {}),
    )
    return out


def judge(run, truth, config):
    """Judge a run, but draw nothing."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(figures, "draw", lambda judgement: [])
        patch.setattr(report, "run_page", lambda *parts: "")
        evaluate(run, truth, config)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Runs `plain`, `weak` (tao is noise), `near` (tao moved a little), all of one recording."""
    folder = tmp_path_factory.mktemp("runs")
    run, truth = judged.seal(folder, n=320)
    run = run.rename(folder / "plain")
    rng = np.random.default_rng(3)
    tao = records.read_run(run).signals["tao"]
    reseal(run, folder / "weak", tao=rng.normal(size=len(tao)))
    reseal(run, folder / "near", tao=tao + rng.normal(0, 0.2, len(tao)))
    for name in ("plain", "weak", "near"):
        judge(folder / name, truth, judged.config())
    return folder


@pytest.fixture
def copy(folder, tmp_path):
    """Return a function that copies a judged run, so that it can be spoilt."""
    return lambda name: shutil.copytree(folder / name, tmp_path / name)


def rows(found, **want):
    table = found.table
    chosen = np.all([table[name] == value for name, value in want.items()], axis=0)
    return {name: values[chosen] for name, values in table.items()}


def test_values_are_those_of_each_runs_own_metrics(folder):
    found = compare.compare([folder / "plain", folder / "weak"])
    for run, column in (("weak", "value"), ("plain", "reference_value")):
        metrics = read_table(folder / run / "metrics.csv", "metrics")
        for signal in compare.SIGNALS:
            at = list(metrics["signal"]).index(signal)
            for measure in ("auroc", "far_at_95", "far", "frr"):
                frames = {"test": measure if measure in ("far", "frr") else f"{measure}_test"}
                if measure in ("auroc", "far_at_95") and signal != "fused":
                    frames["all"] = measure
                for where, name in frames.items():
                    got = rows(found, signal=signal, measure=measure, frames=where)
                    assert got[column] == pytest.approx(metrics[name][at], abs=1e-8)
    difference = found.table["value"] - found.table["reference_value"]
    np.testing.assert_allclose(found.table["difference"], difference)


def test_counts_and_prevalence_stand_in_every_row(folder):
    found = compare.compare([folder / "plain", folder / "weak"])
    label = read_table(folder / "plain" / "labels.csv", "labels")
    for where, chosen in (("all", slice(None)), ("test", label["split"] == "test")):
        got, mine = rows(found, frames=where), label["label"][chosen]
        assert set(got["n_in"]) == {(mine == "in_map").sum()}
        assert set(got["n_out"]) == {(mine == "map_out").sum()}
        np.testing.assert_allclose(got["prevalence"], got["n_out"] / (got["n_in"] + got["n_out"]))


def test_intervals_are_those_of_differences_on_the_same_resamples(folder):
    found = compare.compare([folder / "plain", folder / "near"])
    label = found.runs[0].label
    known, is_out = label != "grey", label == "map_out"
    weights = bootstrap.block_weights(len(label), found.block_frames, 50, 0)
    differences = [
        np.subtract(
            *(
                roc_auc_score(is_out[known], run.signals["tao"][known], sample_weight=drawn[known])
                for run in found.runs[::-1]
            )
        )
        for drawn in weights
    ]
    got = rows(found, signal="tao", measure="auroc", frames="all")
    want = np.percentile(differences, (2.5, 97.5))
    np.testing.assert_allclose([*got["difference_lo"], *got["difference_hi"]], want, atol=1e-12)


def test_pairing_makes_the_interval_of_near_equal_runs_narrower_than_their_own(folder):
    found = compare.compare([folder / "plain", folder / "weak", folder / "near"])
    own = {}
    for run in found.runs[1:]:
        drawn = compare.measure(run, "top1", found.scopes[0])["auroc"][1]
        own[run.name] = np.ptp(bootstrap.interval(drawn))
    got = rows(found, signal="top1", measure="auroc", frames="all")
    assert (got["difference_hi"] - got["difference_lo"] < 1e-9).all()
    assert min(own.values()) > 0.01


def test_a_broken_detector_is_worse_and_from_the_other_side_better(folder):
    for order, finding in ((("plain", "weak"), "worse"), (("weak", "plain"), "better")):
        found = compare.compare([folder / name for name in order])
        got = rows(found, signal="tao", measure="auroc")
        assert set(got["finding"]) == {finding}
        said = " ".join(compare.sentences(found))
        assert re.search(rf"{order[1]} is {finding} than {order[0]} in tao on \d+ in-map", said)
        assert "prevalence" in said
        assert set(rows(found, signal="top1")["finding"]) == {"equal"}


def test_a_run_that_is_the_same_is_called_so(folder, copy):
    found = compare.compare([folder / "plain", copy("plain")])
    said = " ".join(compare.sentences(found))
    assert "carry the same seal: they are one run" in said
    assert set(found.table["finding"]) == {"equal"}
    assert "differences from" in said
    assert "are zero" in said
    assert len({run.name for run in found.runs}) == 2  # two folders of one name


def bare(label, signal):
    """A judged run with one signal and no threshold."""
    none = {"tao": float("nan")}
    return compare.Judged("bare", Path("bare"), {}, {}, {}, label, label, {"tao": signal}, none)


def test_chance_alone_is_rarely_called_a_difference():
    n, n_trials, hits = 300, 60, 0
    label = np.array((["in_map"] * 50 + ["map_out"] * 25) * 4)
    block = compare.Scope("all", np.arange(n), bootstrap.block_weights(n, 20, 100, 0))
    for trial in range(n_trials):
        rng = np.random.default_rng(trial)
        drawn = []
        for _ in range(2):
            signal = rng.normal(size=n) + 1.0 * (label == "map_out")
            drawn.append(compare.measure(bare(label, signal), "tao", block)["auroc"][1])
        low, high = bootstrap.interval(drawn[1] - drawn[0])
        hits += low > 0 or high < 0
    assert hits / n_trials < 0.15


def test_causes_name_settings_and_inputs_that_differ(folder, tmp_path, copy):
    run = copy("plain")
    config = (run / "config.toml").read_text().replace("branches = 100", "branches = 7")
    facts = {"sha256": {"inputs/query/descriptors.npy": "1" * 64}}
    other = reseal(run, tmp_path / "other", config=config, manifest=facts)
    judge(other, folder / "truth", judged.config())
    said = compare.sentences(compare.compare([run, other]))[0]
    assert "stream.branches 7 against 100" in said
    assert "other query/descriptors.npy" in said


def test_runs_with_other_gaps_are_measured_on_the_frames_that_all_hold_out(folder, tmp_path):
    other = reseal(folder / "plain", tmp_path / "long")
    judge(other, folder / "truth", replace(judged.config(), {"window": 30}))
    found = compare.compare([folder / "plain", other])
    held = [int((run.split == "test").sum()) for run in found.runs]
    test = found.scopes[1]
    assert len(test.frame) == min(held) < max(held)
    assert found.block_frames == 60
    assert f"measured are the {len(test.frame)}" in " ".join(compare.sentences(found))


def test_a_recording_without_a_map_out_frame_has_no_intervals_and_says_so(tmp_path):
    run, truth = judged.seal(tmp_path, always_in=True)
    other = reseal(run, tmp_path / "other", tao=np.arange(240.0))
    for path in (run, other):
        judge(path, truth, judged.config())
    found = compare.compare([run, other])
    measured = found.table["measure"] == "frr"
    assert set(found.table["finding"][~measured]) == {"no interval"}
    assert np.isnan(found.table["difference"][~measured]).all()
    assert "differences have no interval" in " ".join(compare.sentences(found))
    compare.write(found, tmp_path / "out", "taojax compare")


def test_the_verb_writes_table_figure_and_page_and_prints_the_words(folder, tmp_path, capsys):
    out = tmp_path / "out"
    words = [str(folder / name) for name in ("plain", "weak", "near")]
    assert main(["compare", *words, "--out", str(out), "--seed", "5"]) == 0
    said = capsys.readouterr().out
    assert "weak is worse than plain in tao" in said
    names = {path.relative_to(out).as_posix() for path in out.rglob("*") if path.is_file()}
    assert names == {
        "compare.md", "compare.json", "tables/compare.csv", "tables/compare.md",
        "tables/compare.tex", "figures/compare.png", "figures/compare.svg", "figures/compare.csv",
    }  # fmt: skip
    table = read_table(out / "tables/compare.csv", "compare")
    assert set(table["run"]) == {"weak", "near"}
    assert len(table["run"]) == 2 * (2 * 6 + 4)
    facts = json.loads((out / "compare.json").read_text())
    assert facts["seed"] == 5
    seal = records.read_manifest(folder / "near")["seal"]
    assert facts["runs"]["near"]["seal"] == seal
    page = (out / "compare.md").read_text()
    assert all(line in page for line in said.strip().splitlines())
    assert (out / "tables/compare.tex").read_text().count(r"\\") == len(table["run"]) + 1


def test_a_taken_out_is_refused_before_anything_is_read(folder, tmp_path, capsys):
    (tmp_path / "mine.txt").write_text("keep")
    words = [str(folder / "plain"), str(folder / "weak"), "--out", str(tmp_path)]
    assert main(["compare", *words]) == 3
    assert "already holds files" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["mine.txt"]


def test_one_run_is_a_usage_error(folder, capsys):
    assert main(["compare", str(folder / "plain")]) == 2
    assert "at least two" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["my,run", "a|b", "50%", 'say "x"', "café"])
def test_odd_folder_names_break_no_table(name, folder, tmp_path):
    odd = shutil.copytree(folder / "weak", tmp_path / name)
    found = compare.compare([folder / "plain", odd])
    compare.write(found, tmp_path / "out", "taojax compare")
    table = read_table(tmp_path / "out" / "tables/compare.csv", "compare")
    assert len(set(table["run"])) == 1
    lines = (tmp_path / "out" / "tables/compare.md").read_text().splitlines()
    assert len({line.count("|") for line in lines}) == 1


def _edit(path, old, new, count=1):
    body = path.read_text()
    assert old in body
    path.write_text(body.replace(old, new, count))


def edited_probability(run):
    head, *rows = (run / "verdicts.csv").read_text().splitlines()
    assert head.endswith(",probability_map_out")
    rows = [row.rpartition(",")[0] + f",{t % 7 / 7}" for t, row in enumerate(rows)]
    (run / "verdicts.csv").write_text("\n".join([head, *rows]) + "\n")


def other_truth(run):
    path = run / "audit.json"
    facts = json.loads(path.read_text()) | {"truth_sha256": "0" * 64}
    path.write_text(json.dumps(facts))


def other_audit(run):
    path = run / "audit.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"run_seal": "1" * 64}))


def edited_labels(run):
    path = run / "labels.csv"
    path.write_text(path.read_text().replace("map_out", "in_map", 30))


def grey_label(run):
    lines = (run / "labels.csv").read_text().splitlines()
    lines[6] = re.sub("in_map|map_out", "grey", lines[6])
    (run / "labels.csv").write_text("\n".join(lines) + "\n")


SPOILT = {
    "no labels": (lambda run: (run / "labels.csv").unlink(), r"labels\.csv: no such file"),
    "not judged": (lambda run: (run / "audit.json").unlink(), "is not judged"),
    "audit.json is no JSON": (lambda run: (run / "audit.json").write_text("{"), "audit.json: is"),
    "audit.json is a list": (lambda run: (run / "audit.json").write_text("[]"), "audit.json: is"),
    "another truth": (other_truth, "different truths"),
    "judged another run": (other_audit, "judges the run with the seal 1111"),
    "edited labels": (edited_labels, "but labels and signals give"),
    "one label made grey": (grey_label, "but labels and signals give"),
    "edited signals": (
        lambda run: (run / "signals.csv").write_text("frame\n0\n"),
        "signals.csv: seal broken",
    ),
    "edited probability": (edited_probability, "auroc_test of fused"),
    "short labels": (
        lambda run: (run / "labels.csv").write_text(
            "\n".join((run / "labels.csv").read_text().splitlines()[:-3]) + "\n"
        ),
        "its frames are not the 320",
    ),
    "row lost": (lambda run: _edit(run / "metrics.csv", "\ntao,", "\nother,"), "no row tao"),
    "summary": (
        lambda run: (run / "manifest.json").write_text('{"scenarios": {}}'),
        "holds several scenarios",
    ),
    "gone": (shutil.rmtree, "no such run folder"),
}


@pytest.mark.parametrize("spoilt", SPOILT)
def test_what_cannot_be_compared_is_refused_with_one_line(spoilt, folder, copy, tmp_path, capsys):
    run = copy("weak")
    spoil, said = SPOILT[spoilt]
    spoil(run)
    words = [str(folder / "plain"), str(run), "--out", str(tmp_path / "out")]
    assert main(["compare", *words]) == 3
    line = capsys.readouterr().err.strip()
    assert re.search(said, line), line
    assert "\n" not in line
    assert not (tmp_path / "out").exists()


def test_other_radii_and_other_recordings_are_refused(folder, tmp_path):
    other = reseal(folder / "plain", tmp_path / "radii")
    judge(other, folder / "truth", judged.config(r_in_m=1.0))
    with pytest.raises(InputError, match="same --r-in and --r-out"):
        compare.compare([folder / "plain", other])
    (tmp_path / "short").mkdir()
    run, truth = judged.seal(tmp_path / "short", n=240)
    judge(run, truth, judged.config())
    with pytest.raises(InputError, match="240 and 320 frames"):
        compare.compare([folder / "plain", run])


def test_a_run_named_twice_is_refused(folder):
    with pytest.raises(InputError, match="named twice"):
        compare.compare([folder / "plain", folder / "weak", folder / "." / "plain"])


def test_every_finding_is_one_that_the_spec_knows(folder):
    found = compare.compare([folder / "plain", folder / "weak", folder / "near"])
    assert tables.to_markdown("compare", found.table).count("\n") == len(found.table["run"]) + 2
    assert set(found.table["finding"]) <= {"better", "worse", "within chance", "equal"}
