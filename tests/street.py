"""A street round a loop, photographed on two drives: files as a user has them."""

import cv2
import numpy as np
import pytest
from conftest import loop, motions

N_MAP, N_QUERY = 60, 50
STEP_PX, WIDE_PX, HIGH_PX = 24, 64, 48
T_S = 1.6e9 + 0.5 * np.arange(N_QUERY)
"""When the query images were taken."""


def wall():
    """Return the houses along the loop, whose end is its beginning."""
    rng = np.random.default_rng(4)
    length = STEP_PX * N_MAP
    out = np.zeros((HIGH_PX, length), np.float32)
    for _ in range(12 * N_MAP):
        x, y = rng.integers(0, length), rng.integers(0, HIGH_PX - 8)
        wide, high = rng.integers(3, 14), rng.integers(3, 24)
        out[y : y + high, (x + np.arange(wide)) % length] = rng.uniform()
    return cv2.GaussianBlur(np.hstack([out, out[:, :WIDE_PX]]), (0, 0), 0.8)


def photograph(folder, names, way_px, seed):
    """Photograph the houses at places along the way, each with its own gain and noise."""
    rng, houses = np.random.default_rng(seed), wall()
    folder.mkdir(parents=True)
    for name, x in zip(names, way_px, strict=True):
        view = houses[:, int(x) : int(x) + WIDE_PX]
        view = view * rng.uniform(0.7, 1.3) + rng.normal(0, 0.03, view.shape)
        full = (view - view.min()) / np.ptp(view)
        assert cv2.imwrite(str(folder / f"{name}.png"), (20_000 + 3_000 * full).astype(np.uint16))
    return folder


def tum(path, t_s, poses):
    """Write stamped poses as other programs do."""
    rows = [(t, x, y, 0, 0, 0, np.sin(a / 2), np.cos(a / 2)) for t, (x, y, a) in
            zip(t_s, poses, strict=True)]  # fmt: skip
    path.write_text("".join(" ".join(f"{v:.9f}" for v in row) + "\n" for row in rows))
    return path


def write_street(folder):
    """Number the map's images, name the query's by nanoseconds, let odometry run twice as fast."""
    rng = np.random.default_rng(5)
    photograph(folder / "day", [f"{k:04d}" for k in range(N_MAP)], STEP_PX * np.arange(N_MAP), 1)
    share = np.arange(N_QUERY) / N_QUERY
    names = [f"{round(t * 1e9)}" for t in T_S]
    photograph(folder / "night", names, STEP_PX * N_MAP * share, 2)
    tum(folder / "day.tum", 1.5e9 + np.arange(N_MAP), loop(N_MAP))
    twice, t_s = loop(2 * N_QUERY), 1.6e9 + 0.25 * np.arange(2 * N_QUERY)
    moved = motions(twice) + rng.normal(0, 0.005, twice.shape)
    head = "t_s,dx_m,dy_m,dtheta_rad"
    np.savetxt(folder / "odometry.csv", np.c_[t_s, moved], "%.6f", ",", header=head, comments="")
    tum(folder / "truth.tum", t_s, twice)
    return folder


def model(path, *, channels=3, side=28, batch="n"):
    """Write a network that averages patches of its input."""
    onnx = pytest.importorskip("onnx", reason="needs onnx: pip install onnx")
    pytest.importorskip("onnxruntime", reason="needs the extra images")
    helper, kind = onnx.helper, onnx.TensorProto.FLOAT
    nodes = [
        helper.make_node("AveragePool", ["image"], ["pooled"], kernel_shape=[7, 7], strides=[7, 7]),
        helper.make_node("Flatten", ["pooled"], ["rows"]),
    ]
    shape = [batch, channels, side, side]
    graph = helper.make_graph(
        nodes, "patches", [helper.make_tensor_value_info("image", kind, shape)],
        [helper.make_tensor_value_info("rows", kind, [batch, channels * (side // 7) ** 2])],
    )  # fmt: skip
    made = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=8)
    onnx.save(made, path)
    return path
