"""README, guide and numbers: their code runs as printed, their links and commands exist."""

import re
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import pytest
from conftest import loop, motions
from jaxtyping import Array, Float

import taojax
from benchmarks import __main__ as benchmarks
from taojax.baselines.models import Frames, Track, clean, track_of_nodes
from taojax.cli import main
from taojax.files.specs import column_names
from taojax.runtime.rivals import SYSTEMS

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "benchmarks/README.md", "notebooks/README.md", "data_specs/README.md")
TEXT = {page: (ROOT / page).read_text(encoding="utf-8") for page in PAGES}
README, GUIDE = TEXT["README.md"], TEXT["notebooks/README.md"]


def blocks(text):
    found = re.findall(r"^( *)```python\n(.*?)^\1```", text, flags=re.S | re.M)
    return [re.sub(f"^{indent}", "", block, flags=re.M) for indent, block in found]


BLOCKS = blocks(README)


def block(start):
    (found,) = [text for text in blocks(GUIDE) if text.startswith(start)]
    return found


def test_bring_your_own_data_runs_as_printed(rng, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    places, queries = loop(30), loop(24)
    names = {
        "map_poses": np.c_[np.arange(30), places],
        "odometry": np.c_[np.arange(24), motions(queries)],
        "query_poses": np.c_[np.arange(24), queries],
        "map_descriptors": rng.normal(size=(30, 8)).astype(np.float32),
        "query_descriptors": rng.normal(size=(24, 8)).astype(np.float32),
    }
    exec(BLOCKS[0], names)
    flags = ["--window", "6", "--branches", "5", "--no-progress", "--out", "run"]
    assert main(["score", "my_data", *flags]) == 0
    assert len((tmp_path / "run/signals.csv").read_text().splitlines()) == 25


def test_the_robot_program_runs_as_printed(rng):
    names = {
        "map_poses": loop(30),
        "map_descriptors": rng.normal(size=(30, 8)).astype(np.float32),
    }
    lists = jnp.arange(20), jnp.linspace(0.9, 0.1, 20)
    names["frames"] = [taojax.Frame(jnp.array([1.0, 0.0, 0.1]), *lists)] * 24
    exec(BLOCKS[1], names)
    assert names["now"]["frame"] == 23
    frames = [final["frame"] for final in names["closures"]]
    assert frames == sorted(set(frames))
    # Nothing is left: every frame has had its final verdict, the last ones by flush.
    assert names["watch"].flush() == names["watch"].finals() == []
    assert not names["watch"]._waiting
    assert taojax.STATUSES[int(names["record"].status)] == "warming_up"


def test_the_library_is_used_as_printed(rng):
    places, queries = loop(60), loop(60)[:24]
    away = np.linalg.norm(queries[:, None, :2] - places[None, :, :2], axis=2)
    like = np.exp(-away / 6.0)
    names = {
        "map_poses": places, "map_descriptors": np.eye(60, dtype=np.float32) + 0.01,
        "query_descriptors": like.astype(np.float32), "odometry": motions(queries),
    }  # fmt: skip
    exec(block("import dataclasses"), names)
    assert names["may_enter"].shape == (24,)
    assert set(names["closures"]) == set(column_names("verdicts"))
    frames = names["frames"]
    stale = taojax.Frame(frames.odometry, frames.index.at[3, 2].set(60), frames.similarity)
    with pytest.raises(taojax.InputError, match="frame 3, rank 2 is 60, but the map has rows 0 to"):
        taojax.verdicts(names["config"], names["tables"], stale)
    p = jnp.asarray(queries[:20, :2], jnp.float32)
    names |= {"p": p, "q": p + 0.1, "params": taojax.CostParams(0.1, 100.0, 1e3, 3.0, 9.0)}
    names |= {"similarity": jnp.ones(20), "has_anchor": jnp.ones(20, bool)}
    names |= {"weight": jnp.full(20, 0.05), "start": jnp.zeros(3)}
    exec(block("def literal"), names)
    assert names["cost"].shape == (3, 24)
    assert names["pull"].shape == (20, 2)
    assert np.isfinite(names["pull"]).all()
    assert names["best"].cost <= names["best"].start_cost


def test_every_name_of_the_face_has_a_docstring_and_every_function_is_in_the_guide():
    for name in set(taojax.__all__) - {"STATUSES", "__version__"}:
        found = getattr(taojax, name)
        assert found.__doc__, name
        assert isinstance(found, type) or f"`{name}`" in GUIDE, name


def test_every_verb_of_the_pages_exists(capsys):
    verbs = set(re.findall(r"`taojax ([a-z]+)\b", "\n".join(TEXT.values())))
    assert verbs >= {"audit", "score", "evaluate", "kidnap", "sweep", "convert", "inspect"}
    for verb in verbs:
        with pytest.raises(SystemExit) as stop:
            main([verb, "--help"])
        assert not stop.value.code
    capsys.readouterr()


def test_every_benchmark_of_the_pages_exists(capsys):
    verbs = set(re.findall(r"python -m benchmarks ([a-z_]+)", "\n".join(TEXT.values())))
    assert verbs >= {"quality", "ablation", "progress", "speed", "reliability", "gallery"}
    for verb in verbs:
        with pytest.raises(SystemExit) as stop:
            benchmarks.main([verb, "--help"])
        assert not stop.value.code
    capsys.readouterr()


def slugs(text):
    heads = re.findall(r"^#+ (.*)$", re.sub(r"```.*?```", "", text, flags=re.S), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", head.lower()).replace(" ", "-") for head in heads}


@pytest.mark.parametrize("page", PAGES)
def test_every_link_leads_to_a_file_and_a_heading(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", TEXT[page]):
        name, _, head = target.partition("#")
        path = (ROOT / page).parent / name if name else ROOT / page
        assert path.exists(), target
        if head:
            assert head in slugs(path.read_text(encoding="utf-8")), target


@pytest.mark.parametrize("page", PAGES)
def test_every_file_of_the_project_that_a_page_names_exists(page):
    named = set(re.findall(r"`((?:taojax|benchmarks|tests|data_specs)/[\w/]+\.\w+)`", TEXT[page]))
    missing = {name for name in named if not (ROOT / name).exists()}
    assert missing <= {"taojax/baselines/nearest.py"}  # the guide has the reader write it


def test_readme_and_guide_stay_short():
    n_words = lambda page: sum(bool(re.search(r"\w", part)) for part in page.split())
    assert n_words(README) <= 1500
    assert n_words(GUIDE) <= 2500


def test_pictures_are_small_and_shown_somewhere():
    for picture in (ROOT / ".github/pictures").iterdir():
        assert picture.stat().st_size < 600_000
        assert any(picture.name in text for text in TEXT.values()), picture.name


def test_the_signal_of_the_guide_is_one_and_goes_where_the_guide_says():
    names = {"Float": Float, "Array": Array, "jnp": jnp}
    exec(block("def contrast"), names)
    stands_out, flat = jnp.array([0.9, 0.1, 0.1]), jnp.array([0.5, 0.5, 0.5])
    assert float(names["contrast"](stands_out)) < float(names["contrast"](flat)) <= 0.0
    assert "margin" in column_names("signals")
    assert '"margin": margin(similarity),' in (ROOT / "taojax/runtime/stream.py").read_text(
        encoding="utf-8"
    )


def test_the_baseline_of_the_guide_is_a_rival(rng):
    names = {"Frames": Frames, "Track": Track, "clean": clean, "np": np}
    names["track_of_nodes"] = track_of_nodes
    exec(block("def nearest"), names)
    rows = rng.random((4, 6)).astype(np.float32)
    index = np.argsort(-rows, axis=1).astype(np.int32)
    best = np.take_along_axis(rows, index, axis=1)
    track = names["nearest"](Frames(loop(6), np.zeros((4, 3)), rows, index, best))
    np.testing.assert_allclose(track.signal, 1.0 - rows.max(axis=1), atol=1e-6)
    assert "nearest" not in SYSTEMS
