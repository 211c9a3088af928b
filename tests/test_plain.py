"""Plain folders with poses: the contract's names, positions in image names, dbStruct, one drive."""

import numpy as np
import pytest
import scipy.io
from conftest import table
from test_descriptors import codes, save

from taojax.datasets.convert import recorded_odometry
from taojax.datasets.descriptors import read_views
from taojax.datasets.odometry import read_odometry as read_drive
from taojax.datasets.plain import found_in, read_plain, read_traverse
from taojax.datasets.reading import Reading
from taojax.errors import InputError

POSE = "t_s,x_m,y_m,theta_rad"
UTM = np.array([352821.0, 4025524.0])


def read_odometry(path, kind, **told):
    """Return the poses alone; what is said about them has tests of its own."""
    return read_drive(path, kind, Reading(**told)).poses


def drive(n):
    return np.c_[np.arange(n) * 0.5, UTM[None] + np.c_[np.arange(n), np.zeros(n)], np.zeros(n)]


@pytest.mark.parametrize("place", ["truth/query_poses.csv", "query/poses.csv"])
def test_a_contract_folder_in_utm_reads(tmp_path, place):
    table(tmp_path / "map/poses.csv", POSE, drive(5))
    table(tmp_path / place, POSE, drive(4))
    mapped, query = read_plain(tmp_path)
    np.testing.assert_allclose(mapped.poses.xyt, drive(5)[:, 1:])
    np.testing.assert_allclose(query.poses.t_s, [0, 0.5, 1, 1.5])
    assert mapped.frames[3] == "000003"
    assert mapped.has_pose


def test_images_beside_the_poses_name_the_frames(tmp_path):
    table(tmp_path / "map/poses.csv", "t_s,x_m,y_m", drive(3)[:, :3])
    table(tmp_path / "query/poses.csv", POSE, drive(4))
    for name in ("a.png", "sub/b.JPG", "z.jpeg", "readme.txt"):
        path = tmp_path / "map/images" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    mapped, query = read_plain(tmp_path)
    assert mapped.frames == ("a.png", "sub/b.JPG", "z.jpeg")
    assert query.frames[0] == "000000"
    np.testing.assert_array_equal(mapped.poses.xyt[:, 2], 0)
    assert "headings" in mapped.notes[0]


def listed(folder, names, side="database"):
    (folder / f"{side}_images_paths.txt").write_text("\n".join(names) + "\n")


def at_name(east, north, number="", zone="52", time=""):
    return f"@{east:010.2f}@{north:010.2f}@{zone}@S@36.1@127.3@{number}@@@@@@{time}@@.jpg"


def round_trip(n):
    angle = np.linspace(0, 2 * np.pi, n, endpoint=False)
    return UTM[None] + 300 * np.stack([np.sin(angle), np.cos(angle)], axis=1)


@pytest.mark.parametrize("as_images", [False, True])
def test_positions_in_image_names_are_poses(tmp_path, as_images):
    straight = [at_name(*row) for row in UTM[None] + np.c_[np.arange(40) * 2.0, np.zeros(40)]]
    for side in ("database", "queries"):
        if not as_images:
            listed(tmp_path, straight, side)
            continue
        (tmp_path / side).mkdir()
        for name in straight:
            (tmp_path / side / name).touch()
    mapped, query = read_plain(tmp_path)
    assert mapped.frames == query.frames == tuple(straight)
    np.testing.assert_allclose(mapped.poses.xyt[:2, 0], [352821.0, 352823.0])
    np.testing.assert_allclose(mapped.poses.xyt[:, 2], 0)
    np.testing.assert_array_equal(mapped.poses.t_s, np.arange(40))
    assert any("row numbers" in note for note in mapped.notes)


@pytest.mark.parametrize("field", ["number", "time"])
def test_images_sorted_by_easting_are_put_in_driving_order(tmp_path, field):
    loop = round_trip(200)
    words = {"number": "run_{}", "time": "20240101_{:06d}"}[field]
    names = [at_name(*xy, **{field: words.format(at)}) for at, xy in enumerate(loop)]
    for side in ("database", "queries"):
        listed(tmp_path, sorted(names), side)
    mapped, _ = read_plain(tmp_path)
    assert mapped.frames == tuple(names)
    np.testing.assert_allclose(mapped.poses.xyt[:, :2], loop, atol=0.01)
    rows = codes(200)
    path = save(tmp_path / "database_descriptors.npy", rows)
    got = read_views(path, path, (mapped, mapped), (np.arange(200), np.arange(200)))
    by_name = {name: row for name, row in zip(sorted(names), rows, strict=True)}
    np.testing.assert_array_equal(got.map_rows, np.array([by_name[name] for name in names]))


def test_names_without_blank_fields_read_as_in_nordland(tmp_path):
    names = [f"@0@{at * 2.4:07.1f}@@@@@{at}@@@@@@@@.jpg" for at in range(20)]
    for side in ("database", "queries"):
        listed(tmp_path, names, side)
    mapped, _ = read_plain(tmp_path)
    np.testing.assert_allclose(mapped.poses.xyt[:, 2], np.pi / 2)


BAD_NAMES = {
    "no position": (["@1@2@.jpg", "a.jpg", "c.jpg"], ["row 2", "'a.jpg'", "@utm_east"]),
    "NaN": (["@1@2@.jpg", "@1@nan@.jpg", "@2@2@.jpg"], ["row 2", "nan"]),
    "unsorted": (["@1@2@.jpg", "@3@2@.jpg", "@2@2@.jpg"], ["row 3", "sorted by name"]),
    "mixed zones": (
        [at_name(1, 2), at_name(2, 2), at_name(3, 2, zone="51")],
        ["row 3", "51S", "52S", "one zone"],
    ),
    "a shuffle": (
        sorted(at_name(*xy) for xy in round_trip(200)),
        ["no drive", "driving order"],
    ),
    "two images": (["@1@2@.jpg", "@2@2@.jpg"], ["2 data row(s)"]),
}


@pytest.mark.parametrize("kind", BAD_NAMES)
def test_bad_image_names_are_one_line(tmp_path, kind):
    names, words = BAD_NAMES[kind]
    for side in ("database", "queries"):
        listed(tmp_path, names, side)
    with pytest.raises(InputError) as caught:
        read_plain(tmp_path)
    message = str(caught.value)
    assert [w for w in ("database_images_paths.txt", *words) if w not in message] == []


def struct(n=4, **changes):
    names = np.empty((n, 1), object)
    names[:, 0] = [f"images-{at:05d}.png" for at in range(n)]
    xy = drive(n)[:, 1:3].T
    fields = {
        "whichSet": "test", "dataset": "oxford", "dbImageFns": names, "qImageFns": names[:3],
        "utmDb": xy, "utmQ": xy[:, :3], "numImages": n, "numQueries": 3, "posDistThr": 10,
        "posDistSqThr": 100, "nonTrivPosDistSqThr": 100,
    }  # fmt: skip
    return {"dbStruct": {k: v for k, v in (fields | changes).items() if v is not None}}


@pytest.mark.parametrize("name", ["oxford.mat", "oxford.db"])
@pytest.mark.parametrize("change", [{}, {"utmDb": drive(4)[:, 1:3]}], ids=["(2, N)", "(N, 2)"])
def test_a_db_struct_gives_names_and_poses(tmp_path, name, change):
    scipy.io.savemat(tmp_path / name, struct(**change), appendmat=False)
    for place in (tmp_path, tmp_path / name):
        mapped, query = read_plain(place)
        assert mapped.frames == tuple(f"images-0000{at}.png" for at in range(4))
        assert len(query.frames) == 3
        np.testing.assert_allclose(mapped.poses.xyt[:, :2], drive(4)[:, 1:3])
    rows = codes(4)
    got = read_views(
        save(tmp_path / "db.npy", rows),
        save(tmp_path / "q.npy", rows[:3]),
        (mapped, query),
        (np.array([0, 1, 3]), np.arange(3)),
    )
    np.testing.assert_array_equal(got.map_rows, rows[[0, 1, 3]])


def test_a_db_struct_of_padded_names_reads(tmp_path):
    scipy.io.savemat(tmp_path / "s.mat", struct(dbImageFns=np.array(["a", "bb", "ccc", "d"])))
    assert read_plain(tmp_path)[0].frames == ("a", "bb", "ccc", "d")


BAD_STRUCTS = {
    "no struct": ({"other": 1}, ["holds no struct dbStruct"]),
    "no positions": (struct(utmDb=None), ["lacks utmDb"]),
    "other number": (struct(utmDb=np.zeros((2, 9))), ["utmDb", "(2, 9)", "4 images"]),
    "NaN": (struct(utmDb=np.full((2, 4), np.nan)), ["utmDb", "image 0"]),
}


@pytest.mark.parametrize("kind", BAD_STRUCTS)
def test_a_bad_db_struct_is_one_line(tmp_path, kind):
    held, words = BAD_STRUCTS[kind]
    scipy.io.savemat(tmp_path / "s.mat", held)
    with pytest.raises(InputError) as caught:
        read_plain(tmp_path)
    assert [word for word in ("s.mat", *words) if word not in str(caught.value)] == []


@pytest.mark.parametrize("raw", [b"", b"\x1f\x8bzipped", b"SQLite format 3\0" * 40, b"text"])
def test_a_db_that_is_no_matlab_file_is_one_line(tmp_path, raw):
    (tmp_path / "s.db").write_bytes(raw)
    with pytest.raises(InputError, match=r"s\.db: .*v5"):
        read_plain(tmp_path)


def test_any_cut_of_a_db_struct_is_one_line(tmp_path):
    scipy.io.savemat(tmp_path / "s.mat", struct(), do_compression=True)
    raw = (tmp_path / "s.mat").read_bytes()
    for at in range(0, len(raw), 31):
        (tmp_path / "s.mat").write_bytes(raw[:at])
        with pytest.raises(InputError):
            read_plain(tmp_path)


def test_a_folder_of_no_kind_or_of_two_kinds_is_refused(tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        read_plain(tmp_path / "none")
    with pytest.raises(InputError, match=r"holds no poses.*map/poses.csv"):
        read_plain(tmp_path)
    (tmp_path / "Thumbs.db").touch()
    table(tmp_path / "map/poses.csv", POSE, drive(3))
    with pytest.raises(InputError, match="neither of truth"):
        read_plain(tmp_path)
    for place in ("truth/query_poses.csv", "query/poses.csv"):
        table(tmp_path / place, POSE, drive(3))
    with pytest.raises(InputError, match="both truth"):
        read_plain(tmp_path)
    scipy.io.savemat(tmp_path / "s.mat", struct())
    with pytest.raises(InputError, match=r"map/poses.csv and s\.mat"):
        read_plain(tmp_path)


BAD_POSES = {
    "two units": (np.array([[1.63e9, 1, 2, 0]] * 3 + [[1.63e12, 2, 2, 0]]), ["row 5", "unit"]),
    "latitude of 1e9": (np.array([[1, 1e9, 2, 0]] * 3), ["row 2", "x_m", "metres"]),
    "reversed time": (drive(40)[::-1], ["row 3", "runs backwards"]),
}


@pytest.mark.parametrize("kind", BAD_POSES)
def test_bad_poses_are_one_line(tmp_path, kind):
    rows, words = BAD_POSES[kind]
    table(tmp_path / "poses.csv", POSE, rows)
    with pytest.raises(InputError) as caught:
        read_traverse(tmp_path)
    assert [word for word in ("poses.csv", *words) if word not in str(caught.value)] == []


def test_a_traverse_may_have_odometry(tmp_path):
    table(tmp_path / "poses.csv", POSE, drive(4))
    assert recorded_odometry(tmp_path) is None
    assert len(read_traverse(tmp_path).frames) == 4
    steps = np.array([[0, 9, 9, 9], [0.5, 1, 0, np.pi / 2], [1, 1, 0, 0]])
    table(tmp_path / "odometry.csv", "t_s,dx_m,dy_m,dtheta_rad", steps)
    motion = recorded_odometry(tmp_path)
    assert motion is not None
    assert (motion.path, motion.kind) == (tmp_path / "odometry.csv", "steps")
    odometry = read_odometry(motion.path, "steps")
    want = [[0, 0, 0], [1, 0, np.pi / 2], [1, 1, np.pi / 2]]
    np.testing.assert_allclose(odometry.xyt, want, atol=1e-5)
    np.testing.assert_allclose(odometry.t_s, [0, 0.5, 1])


def test_a_real_traverse_reads(shared):
    folder = shared / "robotcar_vo/2014_07_14_14_49_50"
    odometry = read_odometry(folder / "odometry.csv", "steps")
    assert len(read_traverse(folder).frames) == len(odometry.t_s) > 100


# Messages


def test_a_folder_of_other_names_says_what_was_looked_for_found_and_helps(tmp_path):
    for name in ("slam.txt", "feat_map.npy", "img/1.png", "img/2.png", ".hidden"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InputError) as caught:
        read_plain(tmp_path)
    found = "found feat_map.npy, slam.txt, img/1.png, img/2.png"
    words = ["looked for map/poses.csv", "queries_images_paths.txt", "dbStruct", found,
             "taojax convert files"]  # fmt: skip
    assert [word for word in words if word not in str(caught.value)] == []
    assert "hidden" not in str(caught.value)
    with pytest.raises(InputError, match=r"no poses\.csv, but feat_map\.npy.*taojax convert files"):
        read_traverse(tmp_path)


def test_a_file_in_the_place_of_a_folder_is_told_of_convert_files(tmp_path):
    (tmp_path / "slam.txt").write_text("0 0 0 0 0 0 0 1\n")
    for read in (read_plain, read_traverse):
        with pytest.raises(InputError, match=r"slam\.txt: is a file, no .*taojax convert files"):
            read(tmp_path / "slam.txt")


def test_many_files_are_counted(tmp_path):
    for row in range(30):
        (tmp_path / f"{row:02d}.npy").touch()
    assert found_in(tmp_path) == "00.npy, 01.npy, 02.npy, 03.npy, 04.npy, 05.npy and 24 more"
    assert found_in(tmp_path / "..").count(".npy") <= 6
