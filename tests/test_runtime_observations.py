"""Bad input gets one line that names file, row and fix; odd but legal input gets numbers."""

import io
import pickle
import zipfile

import numpy as np
import pytest

from taojax.errors import InputError
from taojax.runtime.observations import load_observations

POSES, ODOMETRY = "map/poses.csv", "query/odometry.csv"
MAP, QUERY, LISTS = "map/descriptors.npy", "query/descriptors.npy", "query/retrievals.npz"


def rewrite(path, change):
    path.write_text(change(path.read_text()))


def cell(row, column, text):
    def change(body):
        lines = body.splitlines()
        cells = lines[row - 1].split(",")
        cells[column] = text
        lines[row - 1] = ",".join(cells)
        return "\n".join(lines) + "\n"

    return change


def edit_array(path, change):
    array = np.load(path)
    np.save(path, change(array))


def nan_at(row, column):
    def change(array):
        array[row, column] = np.nan
        return array

    return change


def lists(folder, index, similarity, **more):
    np.savez(folder / LISTS, index=index, similarity=similarity, **more)


def good_lists(n=50, k=7):
    index = np.tile(np.arange(k, dtype=np.int32), (n, 1))
    return index, np.tile(np.linspace(0.9, 0.2, k, dtype=np.float32), (n, 1))


def bad_index(folder):
    index, similarity = good_lists()
    index[4, 2] = 60
    lists(folder, index, similarity)


def rising(folder):
    index, similarity = good_lists()
    similarity[6, 3] = 0.95
    lists(folder, index, similarity)


BREAK = {
    "missing poses": (lambda f: (f / POSES).unlink(), ["poses.csv", "no such file"]),
    "missing odometry": (lambda f: (f / ODOMETRY).unlink(), ["odometry.csv", "no such file"]),
    "missing descriptors": (lambda f: (f / MAP).unlink(), ["map/descriptors.npy", "no such file"]),
    "NaN in a descriptor": (
        lambda f: edit_array(f / QUERY, nan_at(17, 3)),
        ["query/descriptors.npy", "row 17", "column 3", "drop the frame"],
    ),
    "wrong dimension": (
        lambda f: edit_array(f / QUERY, lambda a: a[:, :5]),
        ["query/descriptors.npy", "dimension 5", "16"],
    ),
    "one-dimensional descriptors": (
        lambda f: edit_array(f / MAP, lambda a: a[:, 0]),
        ["map/descriptors.npy", "(60,)"],
    ),
    "integer descriptors": (
        lambda f: edit_array(f / MAP, lambda a: a.astype(int)),
        ["map/descriptors.npy", "int64"],
    ),
    "object array": (
        lambda f: np.save(f / MAP, np.array([{}, 1], dtype=object)),
        ["map/descriptors.npy", "plain numpy array"],
    ),
    "a pickle": (lambda f: (f / MAP).write_bytes(pickle.dumps([1])), ["map/descriptors.npy"]),
    "an empty npy": (lambda f: (f / MAP).write_bytes(b""), ["map/descriptors.npy"]),
    "a row too many": (
        lambda f: edit_array(f / QUERY, lambda a: np.r_[a, a[:1]]),
        ["query/descriptors.npy", "51 rows", "odometry.csv has 50"],
    ),
    "an unparsable cell": (
        lambda f: rewrite(f / POSES, cell(9, 1, "12,5")),
        ["poses.csv", "row 9", "5 cells", "t_s,x_m,y_m,theta_rad"],
    ),
    "a word for a number": (
        lambda f: rewrite(f / ODOMETRY, cell(7, 2, "n/a")),
        ["odometry.csv", "row 7", "dy_m", "'n/a'"],
    ),
    "NaN in a pose": (lambda f: rewrite(f / POSES, cell(5, 2, "nan")), ["row 5", "y_m"]),
    "UTM coordinates": (
        lambda f: rewrite(f / POSES, cell(2, 2, "4025524.6")),
        ["row 2", "y_m", "subtract a local origin"],
    ),
    "time running backwards": (
        lambda f: rewrite(f / ODOMETRY, cell(12, 0, "-4")),
        ["odometry.csv", "row 12", "t_s runs backwards"],
    ),
    "wrong header": (
        lambda f: rewrite(f / POSES, lambda t: t.replace("x_m", "x")),
        ["poses.csv", "row 1", "t_s,x_m,y_m,theta_rad"],
    ),
    "empty file": (lambda f: (f / POSES).write_text(""), ["poses.csv", "empty"]),
    "too few rows": (
        lambda f: rewrite(f / POSES, lambda t: "\n".join(t.splitlines()[:3])),
        ["poses.csv", "2 data row(s)", "at least 3"],
    ),
    "not UTF-8": (
        lambda f: (f / POSES).write_bytes(b"t_s,x_m,y_m,theta_rad\n1,2,\xff,4\n"),
        ["poses.csv", "line 2", "UTF-8"],
    ),
    "a folder for a file": (
        lambda f: ((f / POSES).unlink(), (f / POSES).mkdir()),
        ["poses.csv", "cannot be read"],
    ),
    "an index outside the map": (bad_index, ["retrievals.npz", "row 4", "rank 2", "60"]),
    "a list not best first": (rising, ["retrievals.npz", "row 6", "rank 2", "best first"]),
    "a list of the wrong length": (
        lambda f: lists(f, *good_lists(n=49)),
        ["retrievals.npz", "49 rows", "has 50"],
    ),
    "shapes that differ": (
        lambda f: lists(f, good_lists()[0], good_lists(k=6)[1]),
        ["retrievals.npz", "(50, 7)", "(50, 6)"],
    ),
    "similarities above 1": (
        lambda f: lists(f, good_lists()[0], good_lists()[1] * 100),
        ["retrievals.npz", "at most 1"],
    ),
    "a missing array": (
        lambda f: np.savez(f / LISTS, index=good_lists()[0]),
        ["retrievals.npz", "lacks the array similarity"],
    ),
    "a truncated archive": (
        lambda f: (lists(f, *good_lists()), (f / LISTS).write_bytes((f / LISTS).read_bytes()[:99])),
        ["retrievals.npz", "npz archive"],
    ),
    "an archive of objects": (
        lambda f: np.savez(f / LISTS, index=np.array([{}]), similarity=np.zeros((1, 1))),
        ["retrievals.npz"],
    ),
    "odd notes": (lambda f: (f / "about.toml").write_text("notes = 3"), ["about.toml", "notes"]),
}


@pytest.mark.parametrize("kind", BREAK)
def test_bad_input_is_one_line_with_file_row_and_fix(kind, data_folder):
    change, words = BREAK[kind]
    change(data_folder)
    with pytest.raises(InputError) as caught:
        load_observations(data_folder)
    message = str(caught.value)
    assert "\n" not in message
    assert [word for word in words if word not in message] == []


def test_a_bomb_in_an_archive_is_refused_before_it_unpacks(data_folder, monkeypatch):
    lists(data_folder, *good_lists())
    monkeypatch.setattr("taojax.files.specs.MAX_BYTES", 1000)
    with pytest.raises(InputError, match="unpacks to more than"):
        load_observations(data_folder)


def test_members_that_point_outside_the_folder_are_never_written(data_folder):
    lists(data_folder, *good_lists())
    path = data_folder / LISTS
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("../../evil.npy", b"x")
    load_observations(data_folder)
    assert not (data_folder.parent / "evil.npy").exists()


@pytest.mark.parametrize(
    "dress",
    [
        lambda t: t.replace("\n", "\r\n"),
        lambda t: "\ufeff" + t,
        lambda t: t + "\n\n  \n",
        lambda t: t.replace(",", " , "),
    ],
    ids=["CRLF", "byte-order mark", "trailing blanks", "spaces"],
)
def test_csv_dialects_read_the_same(dress, data_folder):
    plain = load_observations(data_folder)
    path = data_folder / POSES
    path.write_bytes(dress(path.read_text()).encode())
    dressed = load_observations(data_folder)
    for name, column in plain.map_poses.items():
        np.testing.assert_array_equal(column, dressed.map_poses[name])


def test_retrieval_lists_replace_descriptors(data_folder):
    (data_folder / MAP).unlink()
    index, similarity = good_lists()
    index[:, 5:], similarity[:, 5:] = -1, np.nan
    lists(data_folder, index, similarity)
    got = load_observations(data_folder)
    assert got.descriptors is None
    np.testing.assert_array_equal(got.retrievals.similarity[:, 5:], np.zeros((50, 2)))


def test_every_file_that_was_read_is_hashed_and_truth_is_not_among_them(data_folder):
    got = load_observations(data_folder)
    assert set(got.sha256) == {f"inputs/{name}" for name in (POSES, ODOMETRY, MAP, QUERY)}


def test_descriptors_stay_on_disk(data_folder):
    assert isinstance(load_observations(data_folder).descriptors[0], np.memmap)


def test_notes_of_the_data_folder_are_carried(data_folder):
    (data_folder / "about.toml").write_text('notes = ["simulated odometry"]')
    assert load_observations(data_folder).notes == ("simulated odometry",)


def test_a_stored_array_of_another_byte_order_reads_the_same(data_folder):
    want = np.load(data_folder / MAP)
    buffer = io.BytesIO()
    np.save(buffer, want.astype(">f4"))
    (data_folder / MAP).write_bytes(buffer.getvalue())
    np.testing.assert_array_equal(load_observations(data_folder).descriptors[0], want)
