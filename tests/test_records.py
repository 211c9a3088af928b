"""The door: written once, at once, sealed; a broken seal is refused."""

import json
import threading

import numpy as np
import pytest

from taojax.errors import InputError
from taojax.files import records
from taojax.files.specs import column_names, load_spec


def table(n=30):
    out = {name: np.linspace(0, 1, n, dtype=np.float32) for name in column_names("signals")}
    blank = np.full(n, np.nan)
    return out | {
        "frame": np.arange(n),
        "t_s": np.arange(n) * 0.1,
        "status": np.array(["ok"] * n, dtype=object),
        "map_index": np.full(n, -1),
        "now_map_index": np.full(n, -1),
        "x_m": blank,
        "y_m": blank,
        "theta_rad": blank,
    }


def delayed(n=30):
    return {name: np.linspace(0, 1, n) for name in column_names("delayed")} | {
        "frame": np.arange(n),
        "map_index": np.zeros(n, int),
    }


def write(out, **changes):
    n = 30
    poses = {c["name"]: np.arange(5.0) for c in load_spec("map_poses")["columns"]}
    return records.write_run(
        out,
        signals=table(n) | changes,
        delayed=delayed(n),
        map_poses=poses,
        index=np.zeros((n, 100), np.int32),
        similarity=np.ones((n, 100), np.float32),
        config_toml="seed = 0\n",
        manifest={"command": "test", "sha256": {"inputs/map/poses.csv": "0" * 64}},
    )


def test_what_is_written_is_read_back(tmp_path):
    sealed = write(tmp_path / "run")
    run = records.read_run(tmp_path / "run")
    assert run.manifest == sealed
    np.testing.assert_array_equal(run.signals["tao"].astype(np.float32), table()["tao"])
    np.testing.assert_allclose(run.delayed["place"], delayed()["place"], rtol=1e-8)
    assert np.isnan(run.signals["x_m"]).all()
    assert set(run.signals["status"]) == {"ok"}


def test_the_same_run_has_the_same_bytes(tmp_path):
    write(tmp_path / "a")
    write(tmp_path / "b")
    for name in (*records.SEALED, "manifest.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()


@pytest.mark.parametrize("name", records.SEALED)
def test_a_flipped_byte_breaks_the_seal(name, tmp_path):
    write(tmp_path / "run")
    path = tmp_path / "run" / name
    raw = bytearray(path.read_bytes())
    raw[len(raw) // 2] ^= 1
    path.write_bytes(raw)
    with pytest.raises(InputError, match=rf"{name}: seal broken"):
        records.read_run(tmp_path / "run")


def test_an_edited_manifest_breaks_the_seal(tmp_path):
    write(tmp_path / "run")
    path = tmp_path / "run" / "manifest.json"
    manifest = json.loads(path.read_text())
    manifest["sha256"]["inputs/map/poses.csv"] = "1" * 64
    path.write_text(json.dumps(manifest))
    with pytest.raises(InputError, match="manifest was edited"):
        records.read_run(tmp_path / "run")


@pytest.mark.parametrize("body", ["", "{}", "[]", "not json", '{"schema": 9, "sha256": {}}'])
def test_an_odd_manifest_is_refused(body, tmp_path):
    write(tmp_path / "run")
    (tmp_path / "run" / "manifest.json").write_text(body)
    with pytest.raises(InputError, match=r"manifest\.json"):
        records.read_run(tmp_path / "run")


def test_a_run_of_the_first_version_is_refused_in_one_line(tmp_path):
    write(tmp_path / "run")
    path = tmp_path / "run" / "manifest.json"
    manifest = json.loads(path.read_text())
    assert manifest["schema"] == records.SCHEMA == 2
    old = manifest | {"schema": 1}
    path.write_text(json.dumps(old | {"seal": records.seal_of(old)}))
    with pytest.raises(
        InputError, match=r"sealed by taojax 0\.1\.0.*score the data set again"
    ) as told:
        records.read_run(tmp_path / "run")
    assert "\n" not in str(told.value)


def test_a_missing_file_is_refused(tmp_path):
    write(tmp_path / "run")
    (tmp_path / "run" / "retrievals.npz").unlink()
    with pytest.raises(InputError, match=r"retrievals\.npz"):
        records.read_run(tmp_path / "run")


def test_an_existing_run_is_never_overwritten(tmp_path):
    write(tmp_path / "run")
    before = (tmp_path / "run" / "manifest.json").read_bytes()
    with pytest.raises(InputError, match="already holds"):
        write(tmp_path / "run")
    assert (tmp_path / "run" / "manifest.json").read_bytes() == before


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_number_that_is_not_finite_never_reaches_the_disk(value, tmp_path):
    broken = np.ones(30)
    broken[4] = value
    with pytest.raises(InputError, match="column tao, frame 4"):
        write(tmp_path / "run", tao=broken)
    assert not (tmp_path / "run").exists()
    assert list(tmp_path.iterdir()) == []


def test_an_empty_folder_may_be_filled(tmp_path):
    (tmp_path / "run").mkdir()
    write(tmp_path / "run")
    assert (tmp_path / "run" / "signals.csv").is_file()


def test_two_writers_leave_one_whole_run(tmp_path):
    outcomes = []

    def race(name):
        files = {"signals.csv": name.encode() * 1000, "manifest.json": name.encode()}
        try:
            records.publish(tmp_path / "run", files)
            outcomes.append(name)
        except InputError:
            outcomes.append(None)

    threads = [threading.Thread(target=race, args=(name,)) for name in "ab"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    winners = [name for name in outcomes if name]
    assert len(winners) >= 1
    body = (tmp_path / "run" / "signals.csv").read_text()
    assert body == (tmp_path / "run" / "manifest.json").read_text() * 1000
