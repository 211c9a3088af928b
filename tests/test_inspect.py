"""`taojax inspect`: all that is wrong is listed at once; what looks odd is said in plain words."""

import shutil
import subprocess
import sys

import numpy as np
import pytest
from conftest import loop, write_folder

from taojax.cli import main
from taojax.cli.inspect_page import places, scale_of
from taojax.errors import InputError
from taojax.runtime import inspection
from taojax.runtime.inspection import chance, histogram, views
from taojax.runtime.observations import load_observations

ODOMETRY = "t_s,dx_m,dy_m,dtheta_rad"
MAP, QUERY, TRUTH = "map/poses.csv", "query/odometry.csv", "truth/query_poses.csv"


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    rng = np.random.default_rng(2)
    return write_folder(tmp_path_factory.mktemp("healthy") / "data", rng, n_map=150, n_query=120)


@pytest.fixture
def folder(healthy, tmp_path):
    """A copy to spoil."""
    return shutil.copytree(healthy, tmp_path / "data")


def report(capsys, *words):
    """Return exit code, page and errors of one inspection."""
    code = main(["inspect", *map(str, words)])
    said = capsys.readouterr()
    assert "Traceback" not in said.err
    return code, said.out, said.err.strip()


def edit(path, change):
    """Change the numbers of a table."""
    head, *_ = path.read_text().splitlines()
    rows = change(np.loadtxt(path, delimiter=",", skiprows=1))
    np.savetxt(path, rows, "%.6f", ",", header=head, comments="")


def column(at, change):
    def apply(rows):
        rows[:, at] = change(rows[:, at])
        return rows

    return apply


def put_lists(folder, n_query=120, n_map=150, k=6, n_empty=0):
    index = np.tile(np.arange(k, dtype=np.int32), (n_query, 1))
    index[:n_empty] = -1
    similarity = np.tile(np.linspace(0.9, 0.2, k, dtype=np.float32), (n_query, 1))
    np.savez(folder / "query/retrievals.npz", index=index, similarity=similarity)


# The page


def test_a_healthy_folder_is_told_in_full(healthy, capsys):
    assert report(capsys, healthy)[2] == "holding every image against the map"
    code, page, errors = report(capsys, healthy, "--no-progress", "--seed", "7")
    assert (code, errors) == (0, "")
    assert page.rstrip().endswith("--seed 7")
    for words in (
        "map/poses.csv             ok   150 rows",
        "query/descriptors.npy     ok   120 x 16 float32",
        "120 frames, row numbers 0 to 119",
        "knows 100 % of the query stamps",
        "spacing",
        "none",
        "1.00 of the truth",
        "length, map",
        "map with itself",
        "nearest map pose",
        "random pairs",
        "####",
    ):
        assert words in page
    *_, ready, _, command = page.splitlines()
    assert ready.startswith("ready; next")
    assert command == f"taojax audit {healthy} --r-in 5 --r-out 10 --seed 7"


def test_a_folder_without_truth_can_be_scored(folder, capsys):
    shutil.rmtree(folder / "truth")
    code, page, _ = report(capsys, folder)
    assert code == 0
    assert "can be scored, not audited" in page
    assert page.splitlines()[-1] == f"taojax score {folder}"
    assert "true positions" not in page


def test_every_problem_is_listed_and_the_rest_is_still_told(folder, capsys):
    (folder / MAP).write_text((folder / MAP).read_text().replace("x_m", "east"))
    rows = np.load(folder / "map/descriptors.npy")
    rows[7, 3] = np.nan
    np.save(folder / "map/descriptors.npy", rows)
    np.save(folder / "query/descriptors.npy", np.ones((119, 16), np.float32))
    edit(folder / TRUTH, lambda rows: rows[:90])
    (folder / "about.toml").write_text("notes = [")
    code, page, errors = report(capsys, folder)
    assert code == 3
    assert "\n" not in errors
    assert "5 problem(s)" in errors
    for words in (
        f"{folder / MAP}: row 1: header",
        "map/descriptors.npy: row 7 (from 0) is not finite",
        "query/descriptors.npy: 119 rows for 120 frames",
        "query_poses.csv: 90 poses for a run of 120",
        "about.toml: is not TOML",
        "BAD",
        "knows 75 % of the query stamps",
        "odometry",
    ):
        assert words in page
    assert page.splitlines()[-1].startswith("refused: 5 problem(s)")


@pytest.mark.parametrize(
    ("spoil", "words"),
    [
        (lambda f: (f / QUERY).unlink(), ["odometry.csv: no such file"]),
        (lambda f: (f / "map/descriptors.npy").unlink(), ["map/descriptors.npy: no such file"]),
        (lambda f: (f / TRUTH).write_text("t_s\n"), ["query_poses.csv: row 1"]),
        (lambda f: np.save(f / "query/descriptors.npy", np.ones((120, 3), np.float32)),
         ["query/descriptors.npy: dimension 3"]),
        (lambda f: put_lists(f, k=200), ["retrievals.npz: index row 0"]),
        (lambda f: (f / "query/retrievals.npz").write_bytes(b"x"), ["is not a plain npz"]),
    ],
)  # fmt: skip
def test_a_problem_is_exit_3(spoil, words, folder, capsys):
    spoil(folder)
    code, page, _ = report(capsys, folder)
    assert code == 3
    assert [word for word in words if word not in page] == []


def test_help_shows_an_example_and_does_not_import_jax():
    code = (
        "import sys\nfrom taojax.cli import main\n"
        "try:\n    main(['inspect', '--help'])\nexcept SystemExit:\n    pass\n"
        "print([m for m in sys.modules if m in ('jax', 'equinox', 'matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Example: taojax inspect" in done.stdout
    assert done.stdout.splitlines()[-1] == "[]"


def test_no_folder_is_exit_3_with_one_line(tmp_path, capsys):
    code, page, errors = report(capsys, tmp_path / "none")
    assert (code, page) == (3, "")
    assert "no such data folder" in errors
    (tmp_path / "file").touch()
    code, page, errors = report(capsys, tmp_path / "file")
    assert (code, page) == (3, "")
    assert "is a file, no data folder" in errors
    assert "taojax convert files" in errors


def test_a_folder_with_blanks_in_its_name_gives_a_command_to_copy(folder, capsys):
    spaced = folder.rename(folder.with_name("my data"))
    page = report(capsys, spaced)[1]
    assert f"taojax audit '{spaced}' --r-in" in page


def test_truth_of_another_clock_is_refused_unless_told(folder, capsys):
    edit(folder / TRUTH, column(0, lambda t: t + 1e4))
    code, page, errors = report(capsys, folder)
    assert code == 3
    assert "knows 0 % of the query stamps" in errors
    assert "0 % lie in its time span" in page
    code, page, _ = report(capsys, folder, "--anyway")
    assert code == 0
    assert page.splitlines()[-1].startswith(f"taojax audit {folder} --r-in")


def test_lists_are_described(folder, capsys):
    put_lists(folder, n_empty=40)
    code, page, _ = report(capsys, folder)
    assert code == 0
    for words in (
        "0 to 6 per query, median 6",
        "40 of 120",
        "other candidates",
        "33 % of the lists",
    ):
        assert words in page


def big(rows):
    rows[5] *= 1e30
    return rows


def swapped(rows):
    """The bytes of another machine, as far as they are numbers."""
    rows = rows.byteswap()
    return np.where(np.isfinite(rows), rows, np.float32(1.0))


def half_blind(rows):
    """Neighbours look alike on every other stretch of ten frames alone."""
    seen = np.repeat(rows[::10], 10, axis=0)[: len(rows)]
    return np.where((np.arange(len(rows)) // 10 % 2 == 0)[:, None], seen, rows)


ODD = {
    "milliseconds": (QUERY, column(0, lambda t: 1.6e12 + 100 * t), "seem to be milliseconds"),
    "headings": (MAP, column(3, lambda a: np.pi / 2 - a), "deg off the direction"),
    "degrees of yaw": (QUERY, column(3, np.degrees), "is dtheta_rad in degrees?"),
    "kilometres": (QUERY, lambda r: r * [1, 1e-3, 1e-3, 1], "0.001 times the truth"),
    "swapped axes": (QUERY, lambda r: r[:, [0, 2, 1, 3]], "are dx_m (forward) and dy_m"),
    "a jump": (QUERY, lambda r: np.r_[r[:9], r[9:10] + [0, 300, 0, 0], r[10:]], "into row 11"),
    "a map of degrees": (MAP, lambda r: r * [1, 1e-5, 1e-5, 1], "degrees or kilometres"),
    "another frame": (TRUTH, lambda r: r + [0, 9e4, 0, 0], "are map and truth in one frame"),
    "reversed map": (MAP, column(0, lambda t: t[::-1]), "time runs backwards into row 3"),
}


@pytest.mark.parametrize("kind", ODD)
def test_what_looks_odd_is_said_in_plain_words(kind, folder, capsys):
    name, change, words = ODD[kind]
    edit(folder / name, change)
    code, page, _ = report(capsys, folder, "--anyway")
    assert code == 0
    assert words in page.split("\nwarnings\n")[1]


ODD_VIEWS = {
    "long": ("map", lambda a: 20 * a, "brought to 1"),
    "swapped bytes": ("query", swapped, "bytes swapped"),
    "one huge row": ("map", big, "damaged"),
    "zeros": ("query", lambda a: a * (np.arange(len(a)) != 4)[:, None], "row 4 (from 0)"),
    "mixed rows": ("query", lambda a: np.random.default_rng(0).permutation(a), "by chance"),
    "rows of another map": ("map", lambda a: np.random.default_rng(0).permutation(a), "follow map"),
    "a blind network": ("map", half_blind, "expect abstentions"),
}


@pytest.mark.parametrize("kind", ODD_VIEWS)
def test_odd_descriptors_are_said_in_plain_words(kind, folder, capsys):
    side, change, words = ODD_VIEWS[kind]
    path = folder / side / "descriptors.npy"
    with np.errstate(all="ignore"):
        np.save(path, change(np.load(path)).astype(np.float32))
    code, page, _ = report(capsys, folder)
    assert code == 0
    assert words in page.split("\nwarnings\n")[1]


def test_the_pair_of_files_of_vpr_methods_evaluation_just_works(folder, capsys):
    plain = load_observations(folder)
    (folder / "map/descriptors.npy").rename(folder / "database_descriptors.npy")
    (folder / "query/descriptors.npy").rename(folder / "queries_descriptors.npy")
    got = load_observations(folder)
    for one, other in zip(got.descriptors, plain.descriptors, strict=True):
        np.testing.assert_array_equal(one, other)
    assert {"inputs/database_descriptors.npy", "inputs/queries_descriptors.npy"} < set(got.sha256)
    code, page, _ = report(capsys, folder)
    assert code == 0
    assert "queries_descriptors.npy" in page
    np.save(folder / "map/descriptors.npy", plain.descriptors[0])
    with pytest.raises(InputError, match=r"map/descriptors\.npy and database_descriptors\.npy"):
        load_observations(folder)
    assert report(capsys, folder)[0] == 3


def test_real_recordings_are_ready(shared, capsys):
    for name, words in {
        "mit_corridor": ("59 % of the queries lie farther than 10 m", "5 --r-out 10"),
        "intel_lab": ("321 frames are in-map, 121 map-out, 168 between", "1.5 --r-out 3"),
        "tuc_corridor": ("every query lies within 10 m", "5 --r-out 10"),
        "tuc_corridor_mapout": ("122 of 366", "5 --r-out 10"),
    }.items():
        code, page, _ = report(capsys, shared / name)
        assert code == 0
        assert words[0] in page
        assert page.splitlines()[-1] == f"taojax audit {shared / name} --r-in {words[1]}"


def test_real_routes_without_the_rest_are_told_how_to_go_on(shared, capsys):
    code, page, errors = report(capsys, shared / "kaist_routes")
    assert code == 3
    assert "OUT --simulate-descriptors" in errors
    assert "--r-in 10 --r-out 10: a map of 861 m" in page


# The measures


@pytest.mark.parametrize(
    ("stamps", "unit", "duration_s"),
    [
        (np.arange(50.0), "rows", None),
        (np.arange(50.0) * 3, "rows", None),
        (np.arange(50) * 0.1, "s", 4.9),
        (1.6e9 + np.arange(50.0), "s", 49.0),
        (1.6e12 + np.arange(50.0) * 100, "ms", 4.9),
        (1.6e15 + np.arange(50.0) * 1e5, "us", 4.9),
        (1.6e18 + np.arange(50.0) * 1e9, "ns", 49.0),
        (np.arange(50.0) * 500, "ms", 24.5),
        (np.arange(50.0) * 4e5, "us", 19.6),
        (np.zeros(50), "s", 0.0),
    ],
)
def test_units_of_stamps_are_guessed_by_size_or_by_speed(stamps, unit, duration_s):
    got = inspection.clock(stamps, np.full(49, 0.5))
    assert got.unit == unit
    assert got.duration_s is duration_s or got.duration_s == pytest.approx(duration_s, rel=1e-3)


def test_a_robot_that_stands_still_has_a_clock():
    assert inspection.clock(np.arange(9) * 0.1, np.zeros(8)).unit == "s"


def test_matched_share_counts_stamps_within_half_a_step():
    t = np.arange(10.0)
    assert inspection.matched_share(t, t) == (1.0, 1.0)
    assert inspection.matched_share(t, t + 0.4) == (1.0, 0.9)
    assert inspection.matched_share(t, t[::-1][:5]) == (0.5, 0.5)
    assert inspection.matched_share(t, t + 100) == (0.0, 0.0)
    assert inspection.matched_share(t, np.array([3.2])) == (0.1, 0.0)


def there_and_back():
    out = np.c_[np.arange(100.0), np.zeros((100, 2))]
    back = np.c_[np.arange(99.0, -1, -1), np.full(100, 1.0), np.full(100, np.pi)]
    return np.r_[out, back]


def test_revisits_are_counted_in_both_directions():
    once = inspection.map_shape(there_and_back()[:100])
    assert (once.again, once.again_opposed) == (0.0, 0.0)
    twice = inspection.map_shape(np.r_[there_and_back()[:100], there_and_back()[:100]])
    assert twice.again > 0.95
    assert twice.again_opposed < 0.05
    opposed = inspection.map_shape(there_and_back())
    assert opposed.again_opposed > 0.7
    standing = np.r_[there_and_back()[:50], np.repeat(there_and_back()[49:50], 500, axis=0)]
    assert inspection.map_shape(standing).again == 0.0


def test_gaps_of_a_map_are_named_longest_first():
    xyt = there_and_back()[:100]
    xyt[40:, 0] += 30
    xyt[70:, 0] += 60
    got = inspection.map_shape(xyt)
    assert got.gaps == ((70, 61.0), (40, 31.0))
    assert got.spacing_m == pytest.approx(1.0)
    assert got.way_m == pytest.approx(99 + 90)


@pytest.mark.parametrize("turn", [0.0, 0.5, np.pi])
def test_headings_are_held_against_the_direction_of_travel(turn):
    xyt = loop(200)
    xyt[:, 2] += turn
    assert inspection.map_shape(xyt).heading_rad == pytest.approx(turn, abs=0.01)


def test_a_map_that_never_moves_has_a_shape():
    got = inspection.map_shape(np.zeros((5, 3)))
    assert np.isnan(got.heading_rad)
    assert got.gaps == ()


def test_the_scale_of_odometry_survives_a_jump():
    true = np.c_[np.arange(100.0), np.zeros(100)]
    moved = np.c_[np.full(100, 1.1), np.zeros((100, 2))]
    moved[0] = 99.0
    moved[30, 0] = 500.0
    assert scale_of(moved, true) == pytest.approx(1.1)
    got = inspection.steps(moved)
    assert (got.largest_m, got.largest_row) == (500.0, 30)
    assert scale_of(np.zeros((5, 3)), np.zeros((5, 2))) is None


def test_norms_are_measured_in_blocks_of_any_kind():
    rows = np.random.default_rng(0).normal(size=(3000, 900)).astype(np.float16)
    rows[5] = 0
    got = inspection.norms(rows)
    assert got.zero.tolist() == [5]
    assert got.largest == pytest.approx(np.linalg.norm(rows.astype(float), axis=1).max())
    rows[2000, 3] = np.inf
    rows[2500, 3] = np.nan
    with pytest.raises(InputError, match=r"row 2000 .*2 such rows"):
        inspection.norms(rows)


def test_best_matches_are_held_against_truth_and_chance(healthy):
    observations = load_observations(healthy)
    xy = observations.map_xyt[:, :2]
    true_xy = np.loadtxt(healthy / TRUTH, delimiter=",", skiprows=1)[:, 1:3]
    seen = views(observations, xy, 2.0)
    got = places(seen, xy, true_xy, 5.0)
    assert got.right > 0.9
    assert got.chance == chance(xy, 5.0)
    assert got.chance < 0.05
    assert got.nearest_m.max() < 3.0
    mixed = places(seen, xy, true_xy[::-1].copy(), 5.0)
    assert mixed.right < 0.3
    assert np.isnan(places(seen, xy, true_xy + 1e4, 5.0).right)


def test_histograms_share_edges_and_sum_to_one():
    edges, a, b = histogram(np.array([0.0, 1.0]), np.array([0.5]))
    assert len(edges) == 13
    assert (a.sum(), b.sum()) == (1.0, 1.0)
    histogram(np.array([0.5]), np.array([0.5]))
