"""What the benchmark compares is the same cost, and its gate can fail."""

import csv

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop

from taojax.baselines.paper_cost import numpy_cost, svd_cost
from taojax.cli import main
from taojax.core.cost import Branch, branch_cost
from taojax.errors import GateError, InputError
from taojax.runtime import bench, bench_fresh


def test_the_papers_formulation_is_the_cost_that_is_timed_against_it(rng):
    p, q, s, has = bench.random_windows(rng, 50, 20)
    s, has = s.astype(np.float32), has.copy()
    has[0] = False  # nothing to align
    has[1, 2:] = False  # too few frames for a second fit
    want = numpy_cost(bench.WINDOW_PARAMS, p, q, s, has)
    single = (jnp.asarray(a, jnp.float32) for a in (p, q, s))
    single = (*single, jnp.asarray(has))
    np.testing.assert_allclose(svd_cost(bench.WINDOW_PARAMS, *single)[2:], want[2:], rtol=2e-3)
    branches = Branch(jnp.swapaxes(single[1], 0, 1), single[2].T, single[3].T)
    cost = jax.jit(branch_cost, static_argnums=0)
    got = cost(bench.WINDOW_PARAMS, single[0], branches, jnp.full(20, 0.05)).total
    np.testing.assert_allclose(got[2:], want[2:], rtol=2e-3)


ROWS = [bench.Row("numpy_over_step_rank", 5.0, "x"), bench.Row("step_rank_p50_us", 400.0, "us")]


def baseline(tmp_path, *rows):
    path = tmp_path / "baseline.csv"
    path.write_text("name,value,unit,tolerance\n" + "".join(f"{row}\n" for row in rows))
    return path


def test_gate_passes_within_the_tolerance_and_fails_beyond_it(tmp_path):
    lines = bench.check(ROWS, baseline(tmp_path, "numpy_over_step_rank,6,x,0.2"))
    assert lines == ["numpy_over_step_rank 5, at least 4.8"]
    with pytest.raises(GateError, match=r"numpy_over_step_rank 5, at least 5\.4"):
        bench.check(ROWS, baseline(tmp_path, "numpy_over_step_rank,6,x,0.1"))


def test_gate_fails_where_a_figure_is_gone(tmp_path):
    with pytest.raises(GateError, match="numpy_over_replay_rank nan"):
        bench.check(ROWS, baseline(tmp_path, "numpy_over_replay_rank,1,x,0.5"))


@pytest.mark.parametrize("text", ["", "name,value\na,1\n", "name,value,unit,tolerance\na,b,x,0\n"])
def test_a_file_that_is_no_baseline_says_so(text, tmp_path):
    path = tmp_path / "baseline.csv"
    path.write_text(text)
    if not text:
        path.unlink()
    with pytest.raises(InputError, match=r"baseline\.csv: no baseline .*name,value,unit,tolerance"):
        bench.check(ROWS, path)


def test_committed_baseline_names_what_a_run_measures():
    from benchmarks.speed import BASELINE

    with BASELINE.open() as file:
        names = {row["name"] for row in csv.DictReader(file)}
    assert {"numpy_over_replay_rank", "numpy_over_step_joint", "retrieval_of_bandwidth"} <= names


def test_rows_are_written_as_the_contract_says(tmp_path):
    bench.write_rows(ROWS, tmp_path / "new" / "bench.csv")
    lines = (tmp_path / "new" / "bench.csv").read_text().splitlines()
    assert lines == ["name,value,unit", "numpy_over_step_rank,5,x", "step_rank_p50_us,400,us"]


def test_watch_is_timed_from_line_to_answer(tmp_path):
    poses = np.column_stack([np.arange(12.0), loop(12)])
    np.savetxt(tmp_path / "poses.csv", poses, delimiter=",", header="t_s,x_m,y_m,theta_rad",
               comments="")  # fmt: skip
    line = b'{"odometry": [1, 0, 0], "index": [3], "similarity": [0.5]}'
    ready, *rest = bench_fresh.watched(tmp_path, [line] * 30)
    assert (ready.name, ready.unit) == ("watch_ready_s", "s")
    assert [row.name for row in rest] == ["watch_p50_ms", "watch_p99_ms"]
    assert 0 < rest[0].value <= rest[1].value < 1e3 * ready.value
    with pytest.raises(RuntimeError, match="ended at line 1"):
        bench_fresh.watched(tmp_path / "nowhere", [line])


def test_bench_never_writes_over_a_run_and_needs_its_baseline(tmp_path, capsys):
    bench.write_rows(ROWS, tmp_path / "bench.csv")
    assert main(["bench", "--quick", "--out", str(tmp_path)]) == 3
    assert "choose a new --out" in capsys.readouterr().err
    gate = ["--gate", str(tmp_path / "none.csv")]
    assert main(["bench", "--quick", "--out", str(tmp_path / "x"), *gate]) == 3
    assert "no such file" in capsys.readouterr().err


def test_retrieval_is_timed_beside_reading_the_same_memory():
    rows = {row.name: row for row in bench.retrieval(64, 32, 1)}
    of_bandwidth = rows["read_us"].value / rows["retrieval_us"].value
    assert rows["retrieval_of_bandwidth"].value == pytest.approx(of_bandwidth)
    assert rows["retrieval_us"].value > 0


def test_importing_the_package_takes_less_than_importing_the_step(monkeypatch):
    monkeypatch.setattr(bench_fresh, "N_IMPORTS", 1)
    rows = {row.name: row for row in bench_fresh.imports()}
    assert 0.0 < rows["import_taojax_s"].value < rows["import_step_s"].value
    assert {row.unit for row in rows.values()} == {"s"}


def test_the_installed_size_counts_what_is_needed_and_no_extras():
    assert {"jax", "jaxlib", "numpy", "scipy"} <= bench_fresh.needed()
    assert not {"pytest", "ruff", "rosbags", "flatbuffers"} & bench_fresh.needed()
    own, whole = bench_fresh.installed()
    assert (own.name, whole.name) == ("installed_mb", "installed_with_dependencies_mb")
    assert 0.3 < own.value < 20.0
    assert whole.value > 100.0
