"""`taojax convert files`: single files of any name become a data folder, or one line says why."""

import foreign
import numpy as np
import pytest
from conftest import loop, motions

from taojax.cli import main
from taojax.datasets.files import NUMBERED, kind_of, read_motion, read_poses
from taojax.datasets.trajectory import integrate
from taojax.errors import InputError
from taojax.files.tables import MOTION, POSE, read_table, stacked
from taojax.runtime.observations import load_observations

N_MAP, N_QUERY = 60, 40
T_S = 1.6e9 + 0.5 * np.arange(N_QUERY)


@pytest.fixture
def mine(tmp_path):
    """A user's own files: arrays with and without stamps, text of other programs."""
    rng = np.random.default_rng(3)
    places, queries = loop(N_MAP), loop(N_QUERY) + [0.5, 0.0, 0.0]
    moves = motions(queries)
    files = {
        "places": places, "places_t": np.c_[np.arange(N_MAP) * 0.3, places],
        "places_xy": places[:, :2], "where": queries, "where_t": np.c_[T_S, queries],
        "moves": moves, "moves_t": np.c_[T_S, moves], "vo": integrate(moves),
        "feat_a": rng.normal(size=(N_MAP, 8)).astype(np.float32),
        "feat_b": rng.normal(size=(N_QUERY, 8)).astype(np.float32),
    }  # fmt: skip
    for name, rows in files.items():
        np.save(tmp_path / f"{name}.npy", rows)
    texts = {
        "slam.tum": [[f"{t:.6f}", f"{x:.6f}", f"{y:.6f}", "0", "0", "0",
                      f"{np.sin(a / 2):.9f}", f"{np.cos(a / 2):.9f}"]
                     for t, (x, y, a) in zip(T_S, queries, strict=True)],
        "slam.kitti": [[f"{v:.9f}" for v in (np.cos(a), 0, np.sin(-a), -y, 0, 1, 0, 0,
                                             np.sin(a), 0, np.cos(a), x)]
                       for x, y, a in queries],
    }  # fmt: skip
    for name, rows in texts.items():
        foreign.write(tmp_path / name, rows, separator=" ")
    columns = [[f"{v:.6f}" for v in row] for row in np.c_[T_S, queries]]
    foreign.write(tmp_path / "slam.csv", columns, header="t_s,x_m,y_m,theta_rad")
    columns = [[f"{v:.9f}" for v in row] for row in np.c_[T_S, moves]]
    foreign.write(tmp_path / "wheels.txt", columns, header="t_s,dx_m,dy_m,dtheta_rad")
    return tmp_path


def files(folder, out, *words):
    """Run the command; a word that names a file of the folder becomes its path."""
    full = [str(folder / w) if (folder / str(w)).is_file() else str(w) for w in words]
    return main(["convert", "files", str(folder / out), *full])


VIEWS = ("--map-descriptors", "feat_a.npy", "--query-descriptors", "feat_b.npy")
STEPS = ("--odometry", "moves.npy", "--odometry-kind", "steps")


def table(path, spec, names):
    return stacked(read_table(path, spec), names)


def test_four_arrays_without_stamps_are_enough(mine, capsys):
    words = "--map-poses", "places.npy", "--query-poses", "where.npy", *STEPS, *VIEWS
    assert files(mine, "out", *words) == 0
    said = capsys.readouterr().err
    assert f"taojax inspect {mine / 'out'}" in said
    assert NUMBERED in said
    made = load_observations(mine / "out")
    assert made.map_xyt == pytest.approx(np.load(mine / "places.npy"), abs=1e-5)
    assert made.odometry == pytest.approx(np.load(mine / "moves.npy"), abs=1e-5)
    truth = table(mine / "out/truth/query_poses.csv", "query_poses", POSE)
    assert truth == pytest.approx(np.load(mine / "where.npy"), abs=1e-5)
    for own, side in (("feat_a", "map"), ("feat_b", "query")):
        rows = np.load(mine / "out" / side / "descriptors.npy")
        assert np.array_equal(rows, np.load(mine / f"{own}.npy"))


POSES = ["where.npy", "where_t.npy", "slam.tum", "slam.kitti", "slam.csv"]
ODOMETRY = [
    ("moves.npy", "steps"), ("moves_t.npy", "steps"), ("vo.npy", "poses"), ("vo.npy", "csv"),
    ("wheels.txt", None), ("slam.tum", None), ("slam.kitti", None), ("slam.csv", "poses"),
]  # fmt: skip


@pytest.mark.parametrize("poses", POSES)
@pytest.mark.parametrize(("odometry", "kind"), ODOMETRY)
def test_every_kind_of_poses_goes_with_every_kind_of_odometry(mine, poses, odometry, kind):
    told = ("--odometry-kind", kind) if kind else ()
    words = "--map-poses", "places_t.npy", "--query-poses", poses, "--odometry", odometry
    assert files(mine, "out", *words, *told, *VIEWS) == 0
    moved = table(mine / "out/query/odometry.csv", "query_odometry", MOTION)
    assert moved == pytest.approx(np.load(mine / "moves.npy"), abs=2e-4)
    truth = table(mine / "out/truth/query_poses.csv", "query_poses", POSE[:2])
    assert truth == pytest.approx(np.load(mine / "where.npy")[:, :2], abs=1e-4)


@pytest.mark.parametrize(("odometry", "kind"), ODOMETRY)
def test_without_true_poses_the_frames_are_the_rows_of_the_odometry(mine, odometry, kind, capsys):
    told = ("--odometry-kind", kind) if kind else ()
    words = "--map-poses", "places_xy.npy", "--odometry", odometry, *told, *VIEWS
    assert files(mine, "out", *words) == 0
    assert not (mine / "out/truth").exists()
    made = load_observations(mine / "out")
    assert made.odometry == pytest.approx(np.load(mine / "moves.npy"), abs=2e-4)
    assert any("headings are derived" in note for note in made.notes)
    capsys.readouterr()
    assert main(["inspect", str(mine / "out")]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == f"taojax score {mine / 'out'}"


def test_without_odometry_it_is_simulated_and_said(mine, capsys):
    words = "--map-poses", "places.npy", "--query-poses", "where.npy", *VIEWS
    assert files(mine, "out", *words) == 0
    assert "simulated odometry" in capsys.readouterr().err


def test_a_plain_folder_may_lack_true_poses(mine):
    home = mine / "home"
    assert files(mine, "home", "--map-poses", "places.npy", *STEPS, *VIEWS) == 0
    assert main(["convert", "folder", str(home), str(mine / "again")]) == 0
    for name in ("map/poses.csv", "query/odometry.csv"):
        assert (mine / "again" / name).read_bytes() == (home / name).read_bytes()


REFUSED = {
    "no query": (2, ["--map-poses", "places.npy"], ["--odometry", "--query-poses"]),
    "an array of a kind unknown": (
        2, ["--map-poses", "places.npy", "--odometry", "moves.npy", *VIEWS],
        ["moves.npy does not say what it holds", "steps", "poses"]),
    "no views": (
        2, ["--map-poses", "places.npy", *STEPS],
        ["what do the frames look like", "--map-descriptors"]),
    "no map": (3, ["--map-poses", "none.npy", *STEPS], ["none.npy", "(--map-poses)"]),
    "other rows": (
        3, ["--map-poses", "places.npy", "--query-poses", "where.npy", "--odometry", "places.npy",
            "--odometry-kind", "steps", *VIEWS],
        ["places.npy", "60 rows without stamps, but the query has 40 frames"]),
    "views of the other side": (
        3, ["--map-poses", "places.npy", *STEPS, "--map-descriptors", "feat_b.npy",
            "--query-descriptors", "feat_b.npy"], ["feat_b.npy", "40 rows", "60 frames"]),
    "motions for poses": (
        3, ["--map-poses", "wheels.txt", *STEPS, *VIEWS], ["wheels.txt", "holds motions"]),
    "an array of a program": (
        3, ["--map-poses", "places.npy", "--odometry", "moves.npy", "--odometry-kind", "tum",
            *VIEWS], ["moves.npy", "kind is steps or poses"]),
    "nothing to simulate from": (
        3, ["--map-poses", "places.npy", *STEPS, "--simulate-descriptors"], ["without poses"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", REFUSED)
def test_what_does_not_fit_is_one_line(kind, mine, capsys):
    code, words, names = REFUSED[kind]
    assert files(mine, "out", *words) == code
    line = capsys.readouterr().err.strip()
    assert [name for name in names if name not in line] == []
    assert "\n" not in line
    assert not (mine / "out").exists()


# The readers


def edited(change):
    rows = np.c_[T_S, loop(N_QUERY)]
    return change(rows)


def put(rows, at, value):
    rows[at] = value
    return rows


BAD_ARRAYS = {
    "five columns": (lambda r: np.c_[r, r[:, 0]], ["(40, 5)", "expected (N, 3) x, y, theta"]),
    "one axis": (lambda r: r[:, 0], ["has shape (40,)", "expected"]),
    "two rows": (lambda r: r[:2], ["2 row(s)", "at least 3"]),
    "nan": (lambda r: put(r, (7, 1), np.nan), ["row 7 (from 0), column x_m", "not finite"]),
    "degrees": (lambda r: r * [1, 1, 1, 180e3], ["theta_rad", "radians, not degrees"]),
    "reversed": (lambda r: r[::-1], ["row 1 (from 0)", "runs backwards"]),
    "stamps first of three": (lambda r: r[:, :3], ["column x_m", "has 4 columns"]),
    "row numbers first of three": (
        lambda r: np.c_[np.arange(40), r[:, 1:3]], ["look like t, x, y", "store 4 with t"]),
    "text": (lambda r: r.astype(str), ["dtype"]),
    "objects": (lambda r: r.astype(object), ["is not a plain numpy array"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD_ARRAYS)
def test_a_bad_array_is_one_line(kind, tmp_path):
    change, words = BAD_ARRAYS[kind]
    np.save(tmp_path / "p.npy", edited(change))
    with pytest.raises(InputError) as caught:
        read_poses(tmp_path / "p.npy")
    line = str(caught.value)
    assert [word for word in ("p.npy", *words) if word not in line] == []
    assert "\n" not in line


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8", ">f8", "i4"])
def test_numbers_of_any_kind_are_read(dtype, tmp_path):
    rows = np.round(loop(20, radius_m=30.0)).astype(dtype)
    np.save(tmp_path / "p.npy", rows)
    assert read_poses(tmp_path / "p.npy").poses.xyt == pytest.approx(rows.astype(float))


def test_headings_in_degrees_from_row_to_row_are_refused(tmp_path):
    moves = motions(loop(30)) * [1, 1, 180 / np.pi]
    np.save(tmp_path / "m.npy", moves)
    with pytest.raises(InputError, match=r"dtheta_rad.*radians from row to row"):
        read_motion(tmp_path / "m.npy", "steps")


TOLD = {
    "a.npy": ("", None),
    "a.bag": ("x", "bag"),
    "a.g2o": ("x", "g2o"),
    "tum": ("# stamps\n1 0 0 0 0 0 0 1\n", "tum"),
    "kitti 12": ("1 " * 12 + "\n", "kitti"),
    "kitti 13": ("1 " * 13 + "\n", "kitti"),
    "graph": ("VERTEX_SE2 0 1 2 3\n", "g2o"),
    "poses": ("t_s, x_m, y_m, theta_rad\n1,2,3,4\n", "csv"),
    "positions": ("t_s,x_m,y_m\n1,2,3\n", "csv"),
    "steps": ("\ufefft_s,dx_m,dy_m,dtheta_rad\n1,2,3,4\n", "steps"),
    "robotcar": ("source_timestamp,destination_timestamp,x,y,z,roll,pitch,yaw\n", "robotcar-vo"),
    "euroc": ("#timestamp, x\n1403636580838555648,1,2,3,1,0,0,0\n", "csv"),
    "eight numbers": ("1,2,3,4,0,0,0,1\n", "tum"),
    "three numbers": ("1 2 3\n", None),
    "comments": ("# nothing\n", None),
}


@pytest.mark.parametrize("name", TOLD)
def test_a_file_says_what_it_is_or_nothing(name, tmp_path):
    text, want = TOLD[name]
    (tmp_path / name).write_text(text or "x")
    assert kind_of(tmp_path / name) == want


@pytest.mark.parametrize(
    ("name", "text", "words"),
    [
        ("p.csv", "time,lon,up\n1,2,3\n", "lon are degrees.*project"),
        ("p.txt", "1 2 3\n4 5 6\n", r"row 1: 3 columns.*may be x,y,theta or t,x,y; .*--columns"),
        ("p.txt", "1 2 3 4 5\n4 5 6 7 8\n", r"no known file of poses.*\.npy, a table t_s,x_m"),
        ("p.txt", "", "empty"),
    ],
)
def test_unknown_text_is_told_what_is_known(name, text, words, tmp_path):
    (tmp_path / name).write_text(text)
    with pytest.raises(InputError, match=words):
        read_poses(tmp_path / name)
