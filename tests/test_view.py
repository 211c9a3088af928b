"""`taojax view`: the recording holds what the run says, and truth only where it was judged."""

import json
import shutil
import sys

import numpy as np
import pytest

rerun = pytest.importorskip("rerun", reason="needs the extra view: pip install 'taojax[view]'")

from judged import config, seal  # noqa: E402
from rerun.chunk import RrdReader  # noqa: E402

from taojax.audit import figures  # noqa: E402
from taojax.audit.evaluate import evaluate  # noqa: E402
from taojax.cli import main  # noqa: E402
from taojax.files.records import read_run  # noqa: E402
from taojax.files.tables import POSE, read_table, stacked  # noqa: E402
from taojax.view import LABEL_COLOURS, VERDICT_COLOURS  # noqa: E402

N_QUERY = 240


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """A folder with truth/ and, in run/, what was scored on it."""
    folder = tmp_path_factory.mktemp("view")
    seal(folder, whole=True)
    return folder


@pytest.fixture(scope="module")
def scored(data):
    return data / "run"


@pytest.fixture(scope="module")
def judged(data, scored):
    out = data / "judged"
    shutil.copytree(scored, out)
    with pytest.MonkeyPatch.context() as patch:
        # Pictures take most of the time; one is enough for the page.
        patch.setattr(figures, "draw", lambda judgement: (figures.retrieval(judgement),))
        evaluate(out, data / "truth", config())
    return out


def chunks(path):
    """Return what a recording holds: entity -> its columns by name, static ones apart."""
    found = {}
    for chunk in RrdReader(path).stream().to_chunks():
        batch = chunk.to_record_batch()
        columns = dict(zip(batch.schema.names, batch.columns, strict=True))
        found.setdefault((chunk.entity_path, chunk.is_static), {}).update(columns)
    return found


def points(columns):
    """Return positions and colours of every row of an entity."""
    rgba = [np.array(row, np.uint32) for row in columns["Points3D:colors"].to_pylist()]
    places = [
        np.array(row, float).reshape(-1, 3) for row in columns["Points3D:positions"].to_pylist()
    ]
    return places, [np.stack([c >> 24, c >> 16 & 255, c >> 8 & 255], axis=-1) for c in rgba]


def test_the_recording_says_what_the_run_says(scored, tmp_path, capsys):
    out = tmp_path / "run.rrd"
    assert main(["view", str(scored), "--out", str(out)]) == 0
    told = capsys.readouterr()
    assert "map poses, verdicts of decisions.csv" in told.out
    assert f"next: rerun {out}" in told.err
    held, run = chunks(out), read_run(scored)
    verdicts = read_table(scored / "decisions.csv", "verdicts")
    for name, suffix, pose in (
        ("final", "", POSE), ("now", "_now", ("x_now_m", "y_now_m", "theta_now_rad")),
    ):  # fmt: skip
        answers = held[f"/map/answers/{name}", False]
        places, colours = points(answers)
        for place, colour, want, verdict in zip(
            places, colours, stacked(verdicts, pose), verdicts[f"verdict{suffix}"], strict=True
        ):
            assert len(place) == np.isfinite(want[0])
            np.testing.assert_allclose(place[:, :2], want[None, :2][: len(place)], atol=1e-4)
            assert (colour == VERDICT_COLOURS[verdict]).all()
        doubt = held[f"/probability_wrong/{name}", False]
        said = [row[0] for row in doubt["Scalars:scalars"].to_pylist()]
        np.testing.assert_allclose(said, verdicts[f"probability_wrong{suffix}"])
        assert doubt["frame"].to_pylist() == list(range(N_QUERY))
        seconds = [value.total_seconds() for value in doubt["seconds"].to_pylist()]
        np.testing.assert_allclose(seconds, run.signals["t_s"] - run.signals["t_s"][0])
    places, _ = points(held["/map/candidates", False])
    map_m = stacked(run.map_poses, POSE)[:, :2]
    for place, index in zip(places, run.index, strict=True):
        np.testing.assert_allclose(place[:, :2], map_m[index[index >= 0]], atol=1e-4)
    places, _ = points(held["/map/places", True])
    np.testing.assert_allclose(places[0][:, :2], map_m, atol=1e-4)
    assert len(held["/map/trajectory", True]["LineStrips3D:strips"].to_pylist()[0][0]) == N_QUERY
    reasons = [row[0] for row in held["/verdict/final", False]["TextLog:text"].to_pylist()]
    assert reasons[-1] == f"{verdicts['verdict'][-1]}: {verdicts['reason'][-1]}"


def test_without_a_judge_there_is_no_truth_in_it(data, scored, tmp_path, capsys):
    assert (data / "truth/query_poses.csv").is_file()
    assert main(["view", str(scored), "--out", str(tmp_path / "run.rrd")]) == 0
    assert "not judged: no truth in it" in capsys.readouterr().out
    assert [name for name, _ in chunks(tmp_path / "run.rrd") if "truth" in name] == []


def test_truth_of_a_judged_run_is_called_so(data, judged, capsys):
    assert main(["view", str(judged)]) == 0
    assert "verdicts of verdicts.csv" in (said := capsys.readouterr().out)
    assert "truth: labels and true positions" in said
    held = chunks(judged / "view.rrd")
    label = read_table(judged / "labels.csv", "labels")["label"]
    true = stacked(read_table(data / "truth/query_poses.csv", "query_poses"), POSE)
    places, colours = points(held["/map/truth/label", False])
    np.testing.assert_allclose(np.concatenate(places)[:, :2], true[:, :2], atol=1e-4)
    assert [tuple(c[0]) for c in colours] == [LABEL_COLOURS[name] for name in label]
    words = [row[0] for row in held["/truth/label", False]["TextLog:text"].to_pylist()]
    assert words == [f"truth: {name}" for name in label]


def test_a_truth_that_was_not_judged_with_is_not_shown(data, judged, tmp_path, capsys):
    shutil.copytree(judged, run := tmp_path / "judged")
    facts = json.loads((run / "audit.json").read_text())
    (run / "audit.json").write_text(json.dumps(facts | {"truth_sha256": "of another"}))
    assert main(["view", str(run)]) == 0
    assert "truth: labels alone" in capsys.readouterr().out
    names = [name for name, _ in chunks(run / "view.rrd") if "truth" in name]
    assert names == ["/truth/label"]


def test_the_file_opens_with_a_layout_of_its_own(judged, tmp_path):
    assert main(["view", str(judged), "--out", str(tmp_path / "run.rrd")]) == 0
    assert len(RrdReader(tmp_path / "run.rrd").blueprints()) == 1


def test_wrong_words_and_broken_runs_are_one_line(scored, tmp_path, capsys):
    shutil.copytree(scored, run := tmp_path / "run")
    (run / "delayed.csv").write_text("frame\n")
    for words, code, told in (
        (["view", str(scored), "--out", str(tmp_path / "a.txt")], 2, "is no .rrd"),
        (["view", str(run)], 3, "delayed.csv: seal broken"),
        (["view", str(tmp_path / "none")], 3, "manifest.json"),
    ):
        assert main(words) == code
        line = capsys.readouterr().err.strip()
        assert told in line
        assert "\n" not in line
    assert not (run / "view.rrd").exists()


def test_without_the_extra_the_command_to_install_it_is_given(scored, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert main(["view", str(scored)]) == 4
    line = capsys.readouterr().err.strip()
    assert line == "taojax: view needs rerun-sdk; run: python -m pip install 'taojax[view]'"
