# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
#   kernelspec:
#     display_name: Python 3
#     name: python3
# ---

# %% [markdown]
# # 6. Your own data: images, descriptors, odometry, one folder
#
# taojax runs no network. It wants one descriptor per image, poses of the map, and odometry of the
# query. This notebook goes from 14-bit thermal images to a data folder and looks at it before
# anything is judged.

# %%
import tempfile
from pathlib import Path

import numpy as np

from taojax.cli import main
from taojax.datasets.simulate import WorldConfig, make_world

# %% [markdown]
# ## Descriptors of thermal images (AnyThermal with SALAD)
#
# Backbone DINOv2 ViT-B/14, head SALAD: 64 clusters x 128 + token 256 = 8,448 floats. Every step is
# that of the public code, for both sessions alike:
#
# 1. 14-bit image (uint16, 512 x 640) to 8 bit: **each image** from its 1st to its 99th percentile.
#    Counts fill a small part of the whole range, which would give a nearly black image.
# 2. CLAHE: `cv2.createCLAHE(clipLimit=2.0, tileGridSize=(8, 8)).apply(image)`.
# 3. Gray to three equal channels, divided by 255.
# 4. Bilinear to multiples of 14, rounded down (504 x 630); the *published* SALAD weights want
#    322 x 322.
# 5. Subtract the mean, divide by the deviation: AnyThermal those below, published SALAD ImageNet's.
# 6. The network; one row per image, images sorted by name, unit length, float16 or float32.


# %%
def eight_bit(image):
    low, high = np.percentile(image, (1, 99))
    return np.clip((image - low) / max(high - low, 1e-9) * 255, 0, 255).astype(np.uint8)


# %%
MEAN, DEVIATION = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)


# %%
def network_input(gray):
    rgb = np.repeat(gray[None].astype(np.float32) / 255, 3, axis=0)
    return (rgb - np.float32(MEAN)[:, None, None]) / np.float32(DEVIATION)[:, None, None]


# %%
def unit(rows):
    return (rows / np.linalg.norm(rows, axis=1, keepdims=True)).astype(np.float32)


# %%
counts = np.random.default_rng(0).normal(3300, 120, (512, 640)).astype(np.uint16)
gray = eight_bit(counts)
print(f"counts {counts.min()} to {counts.max()} -> {gray.min()} to {gray.max()}")
print(network_input(gray).shape)

# %% [markdown]
# ## A plain folder
#
# Poses, the two descriptor files that VPR-methods-evaluation saves, and odometry in a format that
# you already have: here a TUM trajectory as any visual odometry writes it. The frames are a
# simulated world.

# %%
root = Path(tempfile.mkdtemp())
mine = root / "mine"
world = make_world(WorldConfig(n_map=400, n_query=200, driven_m=1200.0, loop_m=900.0), seed=0)
for side, poses in (("map/poses.csv", world.map_poses), ("query/poses.csv", world.query_poses)):
    (mine / side).parent.mkdir(parents=True)
    head = "t_s,x_m,y_m,theta_rad"
    np.savetxt(mine / side, poses, "%.6f", ",", header=head, comments="")
np.save(mine / "database_descriptors.npy", unit(world.map_descriptors))
np.save(mine / "queries_descriptors.npy", unit(world.query_descriptors))


# %%
def as_tum(poses):
    z, half = np.zeros(len(poses)), poses[:, 3] / 2
    return np.stack([*poses[:, :3].T, z, z, z, np.sin(half), np.cos(half)], axis=1)


# %%
np.savetxt(root / "odometry.tum", as_tum(world.query_poses), "%.9f")

# %% [markdown]
# On the command line: `taojax convert folder mine data --odometry odometry.tum --odometry-kind
# tum`. Public data sets have converters of their own: `taojax convert --help`.

# %%
data = root / "data"
words = ["convert", "folder", str(mine), str(data)]
converted = main([*words, "--odometry", str(root / "odometry.tum"), "--odometry-kind", "tum"])
print(*sorted(str(path.relative_to(data)) for path in data.rglob("*.*")), sep="\n")

# %% [markdown]
# ## Look before you judge
#
# `taojax inspect` checks every file and says in plain words what to expect.

# %%
inspected = main(["inspect", str(data)])
inspected

# %% [markdown]
# From here on: `taojax audit data --r-in 5 --r-out 10`.

# %% [markdown]
# ## A route without poses
#
# The paper's Table 3: a map and a query drive along one route, and nobody knows a pose. Positions
# are progress along the route, two stretches of the map are deleted. On a line every place has the
# same shape, so geometry can only ask whether the matches move on as the odometry does. Descriptors
# here are made up, odometry is **simulated**; `python -m benchmarks progress` does the same with
# real descriptors.

# %%
from taojax.audit.judgement import judge
from taojax.audit.truth import read_truth
from taojax.config import AuditConfig, Config
from taojax.datasets.progress import ProgressConfig, route_of_shares, write_progress
from taojax.records import read_run
from taojax.runtime.score import score

rng = np.random.default_rng(1)
steps = rng.normal(size=(304, 32))
places = sum(steps[k : k + 300] for k in range(5)).astype(np.float32)
seen = (places + rng.normal(0, 3.5, places.shape)).astype(np.float32)

# %%
with tempfile.TemporaryDirectory() as scratch:
    route, run = Path(scratch) / "route", Path(scratch) / "run"
    write_progress(route, route_of_shares(places, seen), ProgressConfig(), seed=0)
    config = Config(audit=AuditConfig(r_in_m=2.0, r_out_m=10.0, n_bootstrap=50))  # rows
    score(route, run, config)
    judged = judge(read_run(run), read_truth(route / "truth", 300), config)

# %% [markdown]
# The literal cost, the similarity gates and the joint cost, over all labelled frames:

# %%
auroc = dict(zip(judged.metrics["signal"], judged.metrics["auroc"], strict=True))
{name: round(float(auroc[name]), 3) for name in ("top1", "top1_w10", "tao_rank", "tao")}

# %% [markdown]
# A straight window is not a degenerate one: every frame after the first two has an answer. Its
# volume is zero by nature, so that `c_geom` and `h_proxy` say nothing on a route.

# %%
statuses, counts = np.unique(judged.signals["status"].astype(str), return_counts=True)
found = {str(s): int(n) for s, n in zip(statuses, counts, strict=True)}
found, float(auroc["c_geom"]), float(auroc["h_proxy"])
