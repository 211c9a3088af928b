"""The benchmarks' figures: each is a PNG, an SVG and the numbers behind it."""

import csv
import dataclasses

import matplotlib.image
import numpy as np
import pytest
from matplotlib.figure import Figure

from benchmarks import ablation, concepts, gallery, pictures, sets, speed
from benchmarks.ablation import Cell
from taojax.datasets.simulate import WorldConfig
from taojax.errors import InputError
from taojax.runtime.bench import Row

NAN = float("nan")
TABLE = {
    "tao: all ingredients": {"real": Cell(0.92, 0.30), "made, up": Cell(0.99, 0.01)},
    "tao: no re-fit": {"real": Cell(0.80, 0.55), "made, up": Cell(0.991, 0.01)},
    "tao: twice delta": {"real": Cell(0.95, 0.20), "made, up": Cell(0.98, 0.05)},
    "final verdict: all features": {"real": Cell(0.99), "made, up": Cell(0.998)},
    "final verdict: without tao": {"real": Cell(0.97), "made, up": Cell(0.998)},
}


@pytest.fixture(scope="module")
def ablated(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ablation")
    ablation.write(folder, TABLE)
    return folder


def test_an_ablation_is_a_table_to_read_and_a_figure_with_its_numbers(ablated):
    assert sorted(path.name for path in ablated.iterdir()) == [
        f"ablation.{suffix}" for suffix in ("csv", "md", "png", "svg")
    ]
    assert (ablated / "ablation.png").read_bytes().startswith(b"\x89PNG")
    assert b"<svg" in (ablated / "ablation.svg").read_bytes()
    assert (
        "| tao: no re-fit | 0.800 / 0.55 | 0.991 / 0.01 |" in (ablated / "ablation.md").read_text()
    )


def test_the_csv_of_an_ablation_holds_every_cell_and_no_far_for_the_probability(ablated):
    with open(ablated / "ablation.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 10
    for row in rows:
        cell = TABLE[row["variant"]][row["set"]]
        assert float(row["auroc"]) == cell.auroc
        assert row["far_at_95"] == ("" if np.isnan(cell.far_at_95) else f"{cell.far_at_95:.6g}")


def test_a_run_measures_every_variant_on_every_set_it_was_asked_for(tmp_path, monkeypatch):
    monkeypatch.setattr(ablation, "SETTINGS", {"all ingredients": {}})
    world = WorldConfig(n_map=220, n_query=160, dimension=32, offset_m=4.0, odometry_scale=0.0)
    made = sets.simulated(world, 3, "default", name="tiny/3", column="tiny")
    recipe = sets.Recipe("tiny/3", lambda: dataclasses.replace(made, r_in_m=30.0, r_out_m=40.0))
    monkeypatch.setattr(ablation, "recipes", lambda *_, **__: [recipe])
    said = []
    ablation.run(tmp_path / "out", tmp_path, only="tiny", say=said.append)
    assert said[0] == "[1/1] tiny/3"
    with open(tmp_path / "out/ablation.csv", newline="") as file:
        rows = {row["variant"]: row for row in csv.DictReader(file)}
    assert {"tao: all ingredients", "final verdict: without vote"} <= set(rows)
    for row in rows.values():
        assert 0.0 <= float(row["auroc"]) <= 1.0


def test_a_variant_that_is_worse_is_an_orange_cross_and_one_that_is_better_a_blue_triangle():
    marks = {}
    for ax in ablation.draw(TABLE).axes[::2][:2]:  # the real set: AUROC, then FAR
        names = [label.get_text() for label in ax.get_yticklabels()]
        for line in ax.lines:
            if line.get_marker() not in ("None", None):
                name = names[round(float(np.ravel(line.get_ydata())[0]))]
                marks.setdefault(name, []).append(line.get_marker())
    assert marks == {
        "all ingredients": ["o", "o"],
        "no re-fit": ["X", "X"],
        "twice delta": ["^", "^"],
    }


CURVES = {
    f"{name} over {axis}": [(10.0, 20.0), (100.0, 150.0), (1000.0, 1300.0)]
    for axis in ("K", "N", "T", "M")
    for name in ("rank", "joint")
} | {"mht bounded hypotheses over t": [(1.0, 1.0), (2.0, 16.0)]}


def test_a_blessed_run_of_speed_is_a_baseline_that_it_passes(tmp_path, monkeypatch):
    rows = [Row("numpy_over_step_rank", 5.0, "x"), Row("step_rank_p50_us", 400.0, "us")]
    monkeypatch.setattr(speed, "BASELINE", tmp_path / "baseline.csv")
    monkeypatch.setattr(speed, "simulated_drive", lambda _: None)
    monkeypatch.setattr(speed.bench, "measure", lambda *_, **__: list(rows))
    for part in ("branches", "window", "time", "map", "tree"):
        monkeypatch.setattr(speed, f"over_{part}", lambda *_: CURVES)
    said = []
    out = tmp_path / "out"
    speed.run(out, quick=True, gate=True, blessed=True, say=said.append)
    assert said[-1] == "numpy_over_step_rank 5, at least 3"
    assert sorted(path.name for path in out.iterdir()) == [
        "bench.csv", "scaling.csv", "scaling.png", "scaling.svg",
    ]  # fmt: skip
    assert (tmp_path / "baseline.csv").read_text().startswith("name,value,unit,tolerance\nnumpy")


def test_the_same_figure_gives_the_same_bytes(tmp_path):
    for name in ("a", "b"):
        figure = Figure()
        figure.subplots().plot([1, 2])
        pictures.save(figure, tmp_path / name / "same", "x\n1\n2\n")
    for suffix in ("png", "svg", "csv"):
        first, second = (tmp_path / name / f"same.{suffix}" for name in ("a", "b"))
        assert first.read_bytes() == second.read_bytes()


def test_the_gallery_runs_its_steps_and_names_the_one_that_fails(tmp_path, monkeypatch):
    ran = []
    monkeypatch.setattr(gallery, "main", lambda words: ran.append(words) or words[0] == "explain")
    with pytest.raises(InputError, match=r"taojax explain .* failed"):
        gallery.run(tmp_path / "a folder")
    assert [words[0] for words in ran] == ["audit", "explain"]
    assert ran[1][1] == str(tmp_path / "a folder/audit/default")


def test_the_sheet_keeps_the_shapes_of_its_pictures(tmp_path):
    for row in gallery.ROWS:
        for name in row.values():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            matplotlib.image.imsave(tmp_path / name, np.ones((40, 60, 3)))
    figure = gallery.sheet(tmp_path)
    assert len(figure.axes) == sum(map(len, gallery.ROWS))
    assert figure.get_figwidth() * 100 == gallery.WIDTH_PX
    assert all("simulated" in ax.get_title() for ax in figure.axes)


def test_the_guide_draws_a_right_place_that_fits_and_a_wrong_one_that_does_not():
    right, wrong = (
        float(ax.get_title().split(": ")[1].split()[0]) for ax in concepts.window().axes[:2]
    )
    assert right < 1.0 < 5.0 < wrong
    assert len(concepts.radii().axes[0].patches) == 2
