"""The benchmark of route progress on tiny sets: what it measures, writes and leaves out."""

import csv

import numpy as np
import pytest

from benchmarks import __main__, progress
from taojax.config import AuditConfig, Config, StreamConfig
from taojax.datasets.progress import ProgressConfig
from taojax.files.specs import load_spec
from taojax.files.tables import read_table

# Rank association compiles quickly; what joint does on a line is in test_progress.py.
SMALL = Config(
    stream=StreamConfig(window=6, branches=12, association="rank"),
    audit=AuditConfig(n_bootstrap=10, block_frames=10),
)


def views(rng, n_map=140, n_query=140):
    places = rng.normal(size=(n_map + 3, 16))
    places = np.sum([places[k : k + n_map] for k in range(4)], axis=0).astype(np.float32)
    at = np.round(np.linspace(0, n_map - 1, n_query)).astype(int)
    return places, (places[at] + rng.normal(size=(n_query, 16))).astype(np.float32)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """What the benchmark wrote and said of a pair like KRI, drives of unequal length."""
    folder, said = tmp_path_factory.mktemp("sets"), []
    (folder / "kri").mkdir()
    both = views(np.random.default_rng(8), n_query=150)
    for side, array in zip(("map", "query"), both, strict=True):
        np.save(folder / f"kri/{side}_descriptors.npy", array)
    with pytest.MonkeyPatch.context() as patch:
        # The others compile anew for every map.
        patch.setattr(progress, "RIVALS", ("mht",))
        titles = {k: v for k, v in progress.TITLES.items() if k not in ("topometric", "seqslam")}
        patch.setattr(progress, "TITLES", titles)
        progress.run(folder / "out", folder, seeds=(0, 1), config=SMALL, say=said.append)
    return folder / "out", said


def test_every_method_has_a_row_per_map_and_seed_and_one_at_another_unit(made):
    table = read_table(made[0] / "progress.csv", "progress")
    assert set(table["method"]) == set(progress.TITLES) - {"topometric", "seqslam"}
    assert len(table["set"]) == 5 * 8
    assert sorted(set(table["n_anchors"])) == [70.0, 140.0]
    assert (table["row_m"] == 5.0).sum() == 8


def test_what_is_fitted_is_measured_on_the_test_half_alone(made):
    table = read_table(made[0] / "progress.csv", "progress")
    fitted = np.isin(list(table["method"]), ["single_view", "joint_features", "fused"])
    assert np.isnan(table["auroc"][fitted]).all()
    assert np.isfinite(table["auroc"][~fitted]).all()
    assert np.isfinite(table["auroc_test"]).all()
    single, joint = (table["auroc_test"][table["method"] == m] for m in ("single_view", "fused"))
    assert (single != joint).any()


def test_gates_do_not_depend_on_the_seed_of_the_odometry(made):
    with open(made[0] / "progress.csv", newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["row_m"] == "1.0"]
    for row in rows:
        if row["method"] not in ("top1", "single_view"):
            continue
        twin = next(r for r in rows if r["seed"] == "0" and all(
            r[k] == row[k] for k in ("set", "n_anchors", "method")
        ))  # fmt: skip
        assert row["auroc_test"] == twin["auroc_test"]


def test_the_page_says_simulated_and_sets_the_paper_apart(made):
    text = (made[0] / "progress.md").read_text()
    assert "**simulated odometry**" in text
    assert "other data" in text
    assert ".628 | .710 | .801" in text
    for method in ("top1", "mht", "tao_rank", "tao", "single_view", "joint_features"):
        assert text.count(progress.TITLES[method]) >= 2


def test_absent_sets_are_named_and_left_out(made, tmp_path, capsys):
    assert sum("skipped" in line for line in made[1]) == 3
    assert __main__.main(["progress", "--out", str(tmp_path / "out"), "--data", str(tmp_path)]) == 0
    said = capsys.readouterr().out
    for recipe in progress.RECIPES:
        assert f"skipped {recipe.name}" in said
    assert "no data set found" in said
    assert not (tmp_path / "out").exists()


def test_the_columns_are_those_of_the_spec(made):
    header = (made[0] / "progress.csv").read_text().splitlines()[0]
    assert header.split(",") == [column["name"] for column in load_spec("progress")["columns"]]


def test_a_match_matrix_decides_where_a_query_is(tmp_path):
    for side, array in zip(("map", "query"), views(np.random.default_rng(8)), strict=True):
        np.save(tmp_path / f"{side}_descriptors.npy", array)
    matches = np.roll(np.eye(140, dtype=bool), 1, axis=0)
    np.savez(tmp_path / "truth_matches.npz", gt_map_by_query=matches)
    route = progress.RECIPES[2].make(tmp_path)
    np.testing.assert_array_equal(route.query_rows[:-1], np.arange(1.0, 140.0))


def test_real_railway_places_keep_their_known_figures(shared, monkeypatch):
    monkeypatch.setattr(progress, "RIVALS", ())
    ours = {name: name for name in ("top1", "tao", "single_view", "fused")}
    monkeypatch.setattr(progress, "TITLES", ours)
    name, folder, make = progress.RECIPES[0]
    config = Config(audit=AuditConfig(n_bootstrap=10))
    rows = progress.measure(make(shared / folder), ProgressConfig(), 0, config)
    found = {row["method"]: row for row in rows}
    assert name == "nordland nr-nq"
    assert (found["tao"]["n_out"], found["tao"]["n_in"]) == (302, 666)
    assert found["top1"]["auroc"] == pytest.approx(0.816, abs=0.002)
    assert found["tao"]["auroc"] > 0.98
    assert found["fused"]["auroc_test"] > found["single_view"]["auroc_test"] + 0.1
