"""`taojax audit --map-images`: from two folders of images to a verdict in one command."""

import shutil
import sys

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs the extra images: pip install 'taojax[images]'")

from conftest import loop  # noqa: E402
from street import N_MAP, N_QUERY, T_S, model, photograph, tum, write_street  # noqa: E402

from taojax.audit import figures  # noqa: E402
from taojax.cli import main  # noqa: E402
from taojax.datasets.from_images import images_of, map_session  # noqa: E402
from taojax.datasets.reading import PLAIN  # noqa: E402
from taojax.datasets.sessions import Matching  # noqa: E402
from taojax.errors import InputError  # noqa: E402
from taojax.files.tables import POSE, read_table, stacked  # noqa: E402

FLAGS = ["--window", "6", "--branches", "5", "--association", "rank", "--no-progress"]
"""Rank compiles in a fraction of the time; what is tested does not depend on it."""
RADII = ["--r-in", "5", "--r-out", "10"]


@pytest.fixture(scope="module")
def street(tmp_path_factory):
    return write_street(tmp_path_factory.mktemp("street"))


def words(street, out, **changes):
    """Return the command; a flag of None is left away."""
    flags = {
        "map_images": street / "day", "query_images": street / "night",
        "map_poses": street / "day.tum", "odometry": street / "odometry.csv", "out": out,
    } | changes  # fmt: skip
    named = [(f"--{name.replace('_', '-')}", str(v)) for name, v in flags.items() if v is not None]
    return ["audit", *(word for pair in named for word in pair), *FLAGS]


@pytest.fixture(scope="module")
def scored(street, tmp_path_factory):
    """A run without truth; later calls beside it keep what it has made."""
    out = tmp_path_factory.mktemp("runs") / "scored"
    assert main(words(street, out)) == 0
    return out


def made(folder):
    """Return the intermediate files beside a run, but for the truth: path -> time of writing."""
    files = (path for path in (folder / "taojax-images").rglob("*") if path.is_file())
    return {path: path.stat().st_mtime_ns for path in files if path.parent.name != "truth"}


def test_without_truth_the_shipped_calibration_decides(scored):
    verdicts = read_table(scored / "decisions.csv", "verdicts")
    is_in = verdicts["verdict"] == "accept"
    assert is_in.mean() > 0.8
    answers = stacked(verdicts, POSE)[is_in, :2]
    away = np.hypot(*(answers - loop(2 * N_QUERY)[::2][is_in, :2]).T)
    assert away.max() < 10.0
    assert not (scored / "labels.csv").exists()
    (data,) = (scored.parent / "taojax-images").glob("data-*")
    assert not (data / "truth").exists()


def test_truth_changes_no_byte_of_what_was_scored_and_nothing_is_made_twice(
    street, scored, capfd, monkeypatch
):
    # Pictures take most of the time; one is enough for the page.
    monkeypatch.setattr(figures, "draw", lambda judgement: (figures.retrieval(judgement),))
    before, out = made(scored.parent), scored.with_name("judged")
    asked = [*words(street, out, truth=street / "truth.tum"), *RADII]
    assert main(asked) == 0
    said = capfd.readouterr().err
    assert said.count("kept, nothing changed") == 3
    assert "note: truth: truth.tum: read as tum" in said
    assert made(scored.parent) == before
    for name in ("signals.csv", "delayed.csv", "decisions.csv"):
        assert (out / name).read_bytes() == (scored / name).read_bytes()
    assert set(read_table(out / "labels.csv", "labels")["label"]) == {"in_map"}
    assert (out / "report.html").is_file()
    assert main(asked) == 0
    assert "is sealed already; going on" in capfd.readouterr().err


def test_other_flags_do_not_touch_a_run(street, scored, capsys):
    sealed = (scored / "manifest.json").read_bytes()
    assert main([*words(street, scored), "--clahe", "0"]) == 3
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.endswith("holds a run of other images, files or flags; choose a new --out")
    assert (scored / "manifest.json").read_bytes() == sealed


def test_a_model_of_the_user_describes_and_all_that_was_made_is_said(street, tmp_path, capfd):
    net = model(tmp_path / "net.onnx", channels=1)
    assert main(words(street, tmp_path / "run", model=net)) == 0
    said = capfd.readouterr().err
    for line in (
        f"map descriptors: {tmp_path}/taojax-images/map-", f"(made of {N_MAP} images, 16-bit",
        f"query descriptors: {tmp_path}/taojax-images/query-", "data folder: ", " (made)",
        "note: map: images are described by net.onnx",
        "note: query: images were taken when their names say",
        "note: decisions.csv is decided with the calibration that ships with taojax",
        "nothing is judged: no --truth; the calibration that ships with taojax decided",
        "next:   taojax closures",
    ):  # fmt: skip
        assert line in said, line
    (rows,) = (tmp_path / "taojax-images").glob("map-*.npy")
    assert np.load(rows).shape == (N_MAP, 16)
    verdicts = read_table(tmp_path / "run/decisions.csv", "verdicts")
    away = np.abs(verdicts["map_index"] / N_MAP - np.arange(N_QUERY) / N_QUERY)
    assert np.mean(np.minimum(away, 1 - away) < 0.05) > 0.7


HALF_GIVEN = {
    "one folder": ({"query_images": None}, [], "add --query-images"),
    "no poses, no odometry": (
        {"map_poses": None, "odometry": None}, [], "add --map-poses and --odometry"),
    "a flag of images alone": (
        dict.fromkeys(("map_images", "query_images", "map_poses", "odometry")),
        ["--model", "net.onnx"], "--model audits images"),
    "images and a dataset": ({}, ["my_data"], "in the place of DATASET"),
    "images and a scenario": ({}, ["--scenario", "h3"], "in the place of DATASET"),
    "flags of a model without one": ({}, ["--size", "28", "28"], "--size goes with --model"),
    "a gate of nothing": ({}, ["--gate-s", "0"], "--gate-s 0.0 must be positive"),
}  # fmt: skip


@pytest.mark.parametrize("kind", HALF_GIVEN)
def test_flags_that_are_half_given_are_named(kind, street, tmp_path, capsys):
    changes, more, told = HALF_GIVEN[kind]
    assert main([*words(street, tmp_path / "run", **changes), *more]) == 2
    line = capsys.readouterr().err.strip()
    assert told in line
    assert "\n" not in line
    assert list(tmp_path.iterdir()) == []


def damage(folder):
    (folder / f"{round(T_S[20] * 1e9)}.png").write_bytes(b"PNG")


def thin(folder):
    for path in sorted(folder.iterdir())[2:]:
        path.unlink()


def twice(folder):
    (folder / "right").mkdir()
    for path in sorted(folder.glob("*.png")):
        shutil.copy(path, folder / "right")


BAD = {
    "a damaged image": (damage, [f"{round(T_S[20] * 1e9)}.png", "is not a readable image", "save"]),
    "two images": (thin, ["night: holds 2 images", "at least 3"]),
    "two cameras": (twice, ["its name is a time not after", "name the folder of one camera"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_bad_images_are_one_line_and_nothing_half_written(kind, street, tmp_path, capsys):
    change, told = BAD[kind]
    shutil.copytree(street / "night", tmp_path / "night")
    change(tmp_path / "night")
    out = tmp_path / "runs/run"
    assert main(words(street, out, query_images=tmp_path / "night")) == 3
    line = capsys.readouterr().err.splitlines()[-1]
    assert [word for word in told if word not in line] == []
    assert not out.exists()
    left = [p.name for p in tmp_path.rglob("*") if "unfinished" in p.name or p.suffix == ".part"]
    assert left == []


BAD_FILES = {
    "no such folder": ({"query_images": "nowhere"}, "nowhere: no such file or folder (--query-im"),
    "poses of another drive": ({"map_poses": "truth.tum"}, "100 rows, but", "holds 60 images"),
    "a file of odometry that is none": ({"odometry": "day/0001.png"}, "0001.png"),
    "truth of another time": ({"truth": "day.tum"}, "day.tum: knows 0% of the 50 query frames"),
}


@pytest.mark.parametrize("kind", BAD_FILES)
def test_bad_files_are_one_line(kind, street, scored, capsys):
    changes, *told = BAD_FILES[kind]
    out = scored.with_name("bad")
    places = {name: street / value for name, value in changes.items()}
    assert main(words(street, out, **places)) == 3
    line = capsys.readouterr().err.splitlines()[-1]
    assert [word for word in told if word not in line] == []
    assert not out.exists()


def test_a_missing_extra_is_exit_code_4(street, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    assert main(words(street, tmp_path / "run")) == 4
    assert "python -m pip install 'taojax[images]'" in capsys.readouterr().err
    assert not (tmp_path / "run").exists()


# Which image has which pose


def test_images_named_by_time_find_poses_of_any_rate(tmp_path):
    names = ["1600000000.250000", "1600000001.250000", "1600000002.750000"]
    images = images_of(photograph(tmp_path / "map", names, [0, 20, 40], 1))
    poses = np.c_[10.0 * np.arange(5), np.zeros(5), np.zeros(5)]
    path = tum(tmp_path / "poses.tum", 1.6e9 + np.arange(5), poses)
    session = map_session(images, path, PLAIN, Matching())
    assert session.frames == tuple(f"{name}.png" for name in names)
    np.testing.assert_allclose(session.poses.xyt[:, 0], [2.5, 12.5, 27.5])


@pytest.mark.parametrize(("name", "seconds"), [
    ("1600000000", 1.6e9), ("1600000000.5", 1600000000.5), ("1600000000500", 1600000000.5),
    ("1600000000500000", 1600000000.5), ("1600000000500000000", 1600000000.5),
    ("1001", None), ("16000000005.5", None), ("160000000", None), ("1600000000_1600000001", None),
])  # fmt: skip
def test_names_that_are_unix_times_are_read_as_such(name, seconds, tmp_path):
    for first in "189":
        (tmp_path / f"{first}{name[1:]}.png").write_bytes(b"x")
    t_s = images_of(tmp_path).t_s
    assert (t_s is None) if seconds is None else (t_s[0] == seconds)


@pytest.mark.parametrize("name", [
    "frame_{}.500000000", "thermal-{}.5-left", "{}_500000000", "cam0_{}-500000000", "{}500",
    "l{}500000000r",
])  # fmt: skip
def test_a_time_inside_a_longer_name_is_read_too(name, tmp_path):
    for second in range(1600000000, 1600000003):
        (tmp_path / f"{name.format(second)}.png").write_bytes(b"x")
    np.testing.assert_allclose(images_of(tmp_path).t_s, 1600000000.5 + np.arange(3), rtol=1e-12)


def test_ten_digits_that_count_frames_are_no_times(tmp_path):
    """Raw KITTI counts frames in ten digits."""
    for k in range(3):
        (tmp_path / f"{k:010d}.png").write_bytes(b"x")
    assert images_of(tmp_path).t_s is None


def test_images_without_times_go_with_rows_and_it_is_said(tmp_path):
    images = images_of(photograph(tmp_path / "map", ["f_2", "f_9", "f_10"], [0, 20, 40], 1))
    path = tum(tmp_path / "poses.tum", 1.6e9 + np.arange(3), loop(3))
    session = map_session(images, path, PLAIN, Matching())
    assert session.frames == ("f_2.png", "f_9.png", "f_10.png")
    want = "the images of map go with the rows of poses.tum one by one, from f_2.png to f_10.png"
    assert session.notes[-1] == want


def test_images_without_times_are_as_many_as_poses(tmp_path):
    images = images_of(photograph(tmp_path / "map", ["a", "b", "c"], [0, 20, 40], 1))
    path = tum(tmp_path / "poses.tum", 1.6e9 + np.arange(4), loop(4))
    with pytest.raises(InputError, match=r"poses\.tum: 4 rows, but .*map holds 3 images; store"):
        map_session(images, path, PLAIN, Matching())
