"""`taojax describe`: images become rows that find their places again; interrupted runs go on."""

import tomllib

import numpy as np
import pytest

cv2 = pytest.importorskip("cv2", reason="needs the extra images: pip install 'taojax[images]'")

from street import model  # noqa: E402

from taojax.cli import main  # noqa: E402
from taojax.datasets import describe as described  # noqa: E402
from taojax.datasets.describe import Preparation, eight_bit, list_images, read_image  # noqa: E402
from taojax.errors import InputError  # noqa: E402

N = 24


def scene():
    """A long facade of warm and cold blocks."""
    rng = np.random.default_rng(2)
    wall = np.zeros((96, 64 * (N + 3)), np.float32)
    for _ in range(40 * N):
        x, y = rng.integers(0, wall.shape[1] - 30), rng.integers(0, 80)
        wall[y : y + rng.integers(5, 40), x : x + rng.integers(5, 30)] = rng.uniform()
    return cv2.GaussianBlur(wall, (0, 0), 1.0)


WALL = scene()


def render(folder, *, shift=0, seed=0, kind="16-bit", n=N):
    """Drive past the facade; another drive has its own place, gain, gradient and noise."""
    rng = np.random.default_rng(seed)
    folder.mkdir()
    for row in range(n):
        x = 64 * row + shift
        view = WALL[:, x : x + 128] * rng.uniform(0.6, 1.4) + rng.normal(0, 0.04, (96, 128))
        view = view + np.linspace(0, rng.uniform(-0.3, 0.3), 128)[None]
        full = (view - view.min()) / np.ptp(view)
        if kind == "16-bit":
            image = (20_000 + 3_000 * full).astype(np.uint16)
        elif kind == "8-bit":
            image = (255 * full).astype(np.uint8)
        else:
            image = np.stack([(255 * full**p).astype(np.uint8) for p in (1.0, 1.5, 0.7)], axis=2)
        assert cv2.imwrite(str(folder / f"{row:04d}.png"), image)
    return folder


def run(folder, out, *words):
    return main(["describe", str(folder), "--out", str(out), "--no-progress", *map(str, words)])


@pytest.mark.parametrize("kind", ["16-bit", "8-bit", "RGB"])
def test_places_are_found_again_in_images_of_every_kind(kind, tmp_path, capsys):
    for name, shift, seed in (("map", 0, 1), ("query", 9, 2)):
        folder = render(tmp_path / name, shift=shift, seed=seed, kind=kind)
        assert run(folder, tmp_path / f"{name}.npy") == 0
    assert f"({'8-bit RGB' if kind == 'RGB' else kind + ' thermal or gray'})" in (
        capsys.readouterr().err
    )
    rows = [np.load(tmp_path / f"{name}.npy") for name in ("map", "query")]
    assert rows[0].shape == (N, 1536)
    assert rows[0].dtype == np.float32
    best = (rows[1] @ rows[0].T).argmax(axis=1)
    assert np.mean(np.abs(best - np.arange(N)) <= 1) >= 0.9


def test_the_recipe_is_written_beside_the_rows(tmp_path):
    folder = render(tmp_path / "map")
    assert run(folder, tmp_path / "map.npy", "--clahe", "3") == 0
    told = tomllib.loads((tmp_path / "map.toml").read_text())
    assert told["method"] == "gist"
    assert told["kind"] == "16-bit thermal or gray"
    assert (told["low_percent"], told["high_percent"], told["clahe_clip"]) == (1.0, 99.0, 3.0)
    assert told["names"] == [f"{row:04d}.png" for row in range(N)]


def test_thermal_counts_are_stretched_and_equalised_as_the_guide_says(tmp_path):
    image = read_image(render(tmp_path / "map", n=3) / "0001.png")
    assert image.dtype == np.uint16
    low, high = np.percentile(image, (1, 99))
    plain = np.clip((image - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    want = cv2.createCLAHE(clipLimit=2.0, tileGridSize=(8, 8)).apply(plain)
    assert np.array_equal(eight_bit(tmp_path, image, Preparation()), want)


@pytest.mark.parametrize(("names", "order"), [
    (["9", "10", "100"], "numbers"),
    (["9.5", "10.25", "10.5"], "numbers"),
    (["frame_9", "frame_10", "frame_100"], "names, numbers in them by size"),
    (["a2/7", "a2/30", "a10/1"], "names, numbers in them by size"),
    (["frame_0009", "frame_0010", "frame_0100"], "names"),
    (["2024-01-05_08", "2024-01-05_10", "2024-02-01_09"], "names"),
])  # fmt: skip
def test_images_are_put_in_the_order_in_which_they_were_taken(names, order, tmp_path):
    for name in names:
        path = tmp_path / f"{name}.png"
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(b"x")
    paths, said = list_images(tmp_path)
    assert [path.relative_to(tmp_path).as_posix() for path in paths] == [f"{n}.png" for n in names]
    assert said == order


def test_an_interrupted_run_goes_on(tmp_path, monkeypatch, capsys):
    folder = render(tmp_path / "map")
    assert run(folder, tmp_path / "whole.npy") == 0
    own, calls = described.gist, []

    def gist(image):
        calls.append(1)
        if len(calls) == 15:
            raise KeyboardInterrupt
        return own(image)

    monkeypatch.setattr(described, "gist", gist)
    assert run(folder, tmp_path / "map.npy", "--batch", 4) == 130
    assert not (tmp_path / "map.npy").exists()
    calls.extend([1] * 100)
    capsys.readouterr()
    assert run(folder, tmp_path / "map.npy", "--batch", 4) == 0
    assert "12 of them from an interrupted run" in capsys.readouterr().err
    assert np.array_equal(np.load(tmp_path / "map.npy"), np.load(tmp_path / "whole.npy"))
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "map", "map.npy", "map.toml", "whole.npy", "whole.toml",
    ]  # fmt: skip


BAD = {
    "a damaged image": (lambda f: (f / "0003.png").write_bytes(b"PNG"), ["0003.png", "readable"]),
    "an image of another kind": (
        lambda f: cv2.imwrite(str(f / "0003.png"), np.arange(99, dtype=np.uint8).reshape(9, 11)),
        ["0003.png", "8-bit", "16-bit"]),
    "a blank image": (
        lambda f: cv2.imwrite(str(f / "0003.png"), np.full((9, 9), 7, np.uint16)),
        ["0003.png", "one value"]),
    "two images": (lambda f: [p.unlink() for p in sorted(f.iterdir())[2:]], ["holds 2 images"]),
}  # fmt: skip


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_folder_is_one_line(kind, tmp_path, capsys):
    change, words = BAD[kind]
    change(folder := render(tmp_path / "map"))
    assert run(folder, tmp_path / "map.npy") == 3
    line = capsys.readouterr().err.strip()
    assert "\n" not in line
    assert [word for word in words if word not in line] == []
    assert not (tmp_path / "map.npy").exists()


def test_rows_that_are_there_are_not_overwritten(tmp_path, capsys):
    folder = render(tmp_path / "map", n=3)
    assert run(folder, tmp_path / "map.npy") == 0
    assert run(folder, tmp_path / "map.npy") == 3
    assert "is there already" in capsys.readouterr().err


@pytest.mark.parametrize("batch", ["n", 1])
@pytest.mark.parametrize("channels", [1, 3])
def test_a_network_sees_what_the_recipe_says(batch, channels, tmp_path):
    folder = render(tmp_path / "map", n=5)
    net = model(tmp_path / "net.onnx", channels=channels, batch=batch)
    assert run(folder, tmp_path / "map.npy", "--model", net, "--batch", 2) == 0
    rows, told = np.load(tmp_path / "map.npy"), tomllib.loads((tmp_path / "map.toml").read_text())
    assert (told["method"], told["size"], told["channels"]) == ("onnx", [28, 28], channels)
    for at in (0, 4):
        path = folder / f"{at:04d}.png"
        gray = eight_bit(path, read_image(path), Preparation()).astype(np.float32) / 255
        small = cv2.resize(gray, (28, 28), interpolation=cv2.INTER_LINEAR)
        mean, deviation = np.array(told["mean"]), np.array(told["deviation"])
        planes = (small[None] - mean[:, None, None]) / deviation[:, None, None]
        want = planes.reshape(channels, 4, 7, 4, 7).mean((2, 4)).ravel()
        assert rows[at] == pytest.approx(want, abs=1e-4)


def test_a_file_that_is_no_model_is_one_line(tmp_path, capsys):
    pytest.importorskip("onnxruntime", reason="needs the extra images")
    folder = render(tmp_path / "map", n=3)
    (tmp_path / "net.onnx").write_bytes(b"no model")
    assert run(folder, tmp_path / "map.npy", "--model", tmp_path / "net.onnx") == 3
    line = capsys.readouterr().err.strip()
    assert "net.onnx: is not a readable ONNX model" in line
    assert "\n" not in line


def test_flags_of_models_need_one(tmp_path):
    assert run(tmp_path, tmp_path / "map.npy", "--size", "28", "28") == 2


def test_a_constant_row_is_named(tmp_path):
    with pytest.raises(InputError, match=r"b\.png: its descriptor"):
        described._check_rows([tmp_path / "a.png", tmp_path / "b.png"], np.eye(2)[:, :1])
