"""What a folder lacks is said at once, before anything heavy is imported."""

import shutil
import subprocess
import sys

import pytest

from taojax.cli.layout import check_layout
from taojax.errors import InputError


def test_a_wrong_folder_is_refused_before_anything_heavy_is_imported(tmp_path):
    code = (
        "import sys\nfrom taojax.cli import main\n"
        f"assert main(['inspect', {str(tmp_path / 'none')!r}]) == 3\n"
        "print([m for m in sys.modules if m in ('jax', 'scipy', 'numpy', 'matplotlib')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.splitlines()[-1] == "[]"


PARTLY = {
    "nothing": ([], ["map/poses.csv, query/odometry.csv, map/descriptors.npy with query/desc",
                     "(or query/retrievals.npz) and truth/query_poses.csv", "it holds nothing"]),
    "other names": (["a.npy", "b.npy", "c.txt", "d/e.csv", "f.txt"],
                    ["it holds a.npy, b.npy, c.txt, d/ and 1 more", "taojax convert files"]),
    "one drive": (["poses.csv"], ["this is one drive", "--map FOLDER_OF_THE_MAP"]),
    "poses alone": (["map/poses.csv", "truth/query_poses.csv"],
                    ["lacks query/odometry.csv and map/descr", "OUT --simulate-descriptors"]),
    "half a pair": (["map/poses.csv", "query/odometry.csv", "queries_descriptors.npy"],
                    ["lacks database_descriptors.npy and truth/query_poses.csv"]),
    "no truth": (["map/poses.csv", "query/odometry.csv", "query/retrievals.npz"],
                 ["truth/query_poses.csv: no such file", "taojax score"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", PARTLY)
def test_all_that_a_folder_lacks_is_said_at_once(kind, tmp_path):
    names, words = PARTLY[kind]
    for name in names:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    with pytest.raises(InputError) as caught:
        check_layout(tmp_path, has_truth=True)
    assert [word for word in words if word not in str(caught.value)] == []
    assert "\n" not in str(caught.value)


def test_a_folder_that_lacks_nothing_passes(data_folder):
    check_layout(data_folder, has_truth=True)
    shutil.rmtree(data_folder / "truth")
    check_layout(data_folder, has_truth=False)
