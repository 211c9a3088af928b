"""A made-up robot whose truth is known, sealed like a real run, for the tests of the judge."""

import numpy as np
import pytest

from taojax.audit import figures
from taojax.audit.evaluate import evaluate
from taojax.config import AuditConfig, Config, StreamConfig, to_toml
from taojax.decisions import decide
from taojax.files import records
from taojax.files.specs import column_names
from taojax.files.tables import table_text
from taojax.risk import Calibration, Risk, for_run, shipped
from taojax.risk import to_toml as calibration_toml

N_CANDIDATES = 100


def config(**changes):
    audit = {"r_in_m": 5.0, "r_out_m": 10.0, "n_bootstrap": 50, "block_frames": 20} | changes
    return Config(stream=StreamConfig(window=10), audit=AuditConfig(**audit))


def world(n=240, *, always_in=False, seed=7):
    """Return truth positions and a map: a straight road whose middle parts were never mapped."""
    rng = np.random.default_rng(seed)
    x = np.cumsum(rng.uniform(1.5, 2.5, n))
    truth = np.stack([x, rng.normal(0, 0.5, n)], axis=1)
    map_x = np.arange(0.0, x[-1] + 4.0, 2.0)
    phase = (map_x / x[-1] * 6) % 2  # three stretches with a map, three without
    keep = np.full(len(map_x), True) if always_in else phase < 1.2
    return truth, np.stack([map_x[keep], np.zeros(keep.sum())], axis=1)


def made_up(name="cost", middle=0.5, gain=8.0, **changes):
    """Return numbers that look at one feature, now and finally: wrong from `middle` on."""
    one, share = np.ones(1), np.array([0.05])
    now = Risk(("now_" + name,), middle * one, one, gain * one, 0.0, share, 0.3 * one, 0.05,
               "made up")  # fmt: skip
    final = now._replace(columns=(name,))
    return Calibration(now, final, **{"map_out": shipped().map_out} | changes)


def features(columns, is_wrong, rng, numbers):
    """Return made-up features of answers, on which shipped numbers tell most wrong from right."""
    n = len(is_wrong)
    loud = np.where(is_wrong, 0.5, -0.5) + 0.2 * rng.normal(size=n)
    found = {name: rng.normal(size=n) for name in columns}
    for name, mean, scale, weight in zip(
        numbers.columns, numbers.mean, numbers.scale, numbers.weight, strict=True
    ):
        found[name] = mean + scale * (np.sign(weight) * loud + 0.1 * found[name])
    return found


def answered(answer, map_index, is_wrong, rng):
    """Return the causal columns of signals.csv, and delayed.csv, of one row of answers."""
    said = {"map_index": map_index, "x_m": answer[:, 0], "y_m": answer[:, 1]}
    said["theta_rad"] = np.zeros(len(answer))
    now = [name for name in column_names("signals") if name.startswith("now_")]
    final = list(column_names("delayed"))
    spread = {name: np.full(len(answer), v) for name, v in
              (("var_x_m2", 0.5), ("var_y_m2", 0.5), ("cov_xy_m2", 0.0))}  # fmt: skip
    pose = {f"now_{name}": values for name, values in said.items()}
    return (
        features(now, is_wrong, rng, shipped().now) | pose,
        features(final, is_wrong, rng, shipped().final)
        | {"frame": np.arange(len(answer))} | said | spread,
    )  # fmt: skip


def decided(truth, signals, delayed):
    """Return what a run holds that also decided, and its odometry."""
    numbers = for_run(shipped(), 0.05, config().verdict.lag)
    step = np.diff(truth, axis=0, prepend=truth[:1])
    columns = {"t_s": signals["t_s"], "dx_m": step[:, 0], "dy_m": step[:, 1]}
    odometry = table_text("query_odometry", columns | {"dtheta_rad": np.zeros(len(truth))})
    return {
        "odometry": odometry.encode(),
        "decisions": decide(numbers, signals, delayed),
        "calibration_toml": calibration_toml(numbers),
    }


def seal(  # noqa: PLR0913 - what a run may be
    folder, *, n=240, always_in=False, seed=7, status=None, notes=("simulated",), whole=False
):
    """Write a sealed run and its truth; return (run folder, truth folder).

    A whole run holds its odometry and has decided.
    """
    rng = np.random.default_rng(seed + 1)
    truth, map_m = world(n, always_in=always_in, seed=seed)
    gap = np.linalg.norm(truth[:, None] - map_m[None], axis=2)
    is_out = gap.min(axis=1) > 10
    order = np.argsort(gap + rng.normal(0, 2, gap.shape), axis=1)[:, :N_CANDIDATES]
    index = np.full((n, N_CANDIDATES), -1)
    index[:, : order.shape[1]] = order
    answer = map_m[index[:, 0]] + rng.normal(0, 0.3, (n, 2))
    signals = {"frame": np.arange(n), "t_s": np.arange(n) * 0.5}
    signals["status"] = np.full(n, "ok", dtype=object)
    signals["status"][:2] = "warming_up"
    if status is not None:
        signals["status"][:] = status
    signals["map_index"] = index[:, 0]
    signals |= {"x_m": answer[:, 0], "y_m": answer[:, 1], "theta_rad": np.zeros(n)}
    for number, name in enumerate(records.signal_names()):
        signals[name] = rng.normal(0, 1, n) + (0.3 * (number % 8)) * is_out
    signals["tao"] += 4.0 * is_out
    is_wrong = np.hypot(*(answer - truth).T) > config().audit.wrong_m
    now, delayed = answered(answer, index[:, 0], is_wrong, rng)
    blank = np.full((len(map_m), 2), 0.0)
    run = folder / "run"
    records.write_run(
        run,
        signals=signals | now,
        delayed=delayed,
        map_poses={"t_s": np.arange(len(map_m)), "x_m": map_m[:, 0], "y_m": map_m[:, 1]}
        | {"theta_rad": blank[:, 0]},
        index=index,
        similarity=np.where(index >= 0, 0.5, 0.0),
        config_toml=to_toml(config()),
        manifest={"command": "taojax score made-up", "dataset": "made-up", "notes": list(notes)}
        | ({"map_spacing_m": 2.0, "dataset": str(folder)} if whole else {}),
        **(decided(truth, signals | now, delayed) if whole else {}),
    )
    (folder / "truth").mkdir()
    rows = [f"{0.5 * i},{x!r},{y!r},0.0" for i, (x, y) in enumerate(truth.tolist())]
    text = "\n".join(["t_s,x_m,y_m,theta_rad", *rows]) + "\n"
    (folder / "truth" / "query_poses.csv").write_text(text)
    return run, folder / "truth"


def evaluated(folder, **changes):
    """Seal a run and judge it; return (run folder, evaluation)."""
    run, truth = seal(folder, **changes)
    with pytest.MonkeyPatch.context() as patch:
        # Pictures take most of the time; one is enough for the page.
        patch.setattr(figures, "draw", lambda judgement: (figures.retrieval(judgement),))
        return run, evaluate(run, truth, config())
