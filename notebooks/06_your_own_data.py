# ---
# jupyter:
#   jupytext:
#     formats: ipynb,py:percent
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
import os
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np

from taojax import read_run
from taojax.cli import main
from taojax.datasets.simulate import WorldConfig, make_world

os.chdir(tempfile.mkdtemp())  # all that is written below

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


# %% [markdown]
# A made-up scene, warmer towards the ground and with one warm thing in it. Left the whole range,
# right what the network should see.

# %%
row, column = np.mgrid[:512, :640]
scene = 3300 + 0.4 * row + 150 * (np.hypot(row - 330, column - 430) < 60)
counts = np.random.default_rng(0).normal(scene, 6).astype(np.uint16)
gray = eight_bit(counts)
print(f"counts {counts.min()} to {counts.max()} -> {gray.min()} to {gray.max()}")
print(network_input(gray).shape)

# %%
figure, axes = plt.subplots(1, 2, figsize=(7, 3), layout="constrained")
for ax, image, title in zip(
    axes, (counts >> 6, gray), ("14 bits to 8", "1 % to 99 %"), strict=True
):
    ax.imshow(image, cmap="gray", vmin=0, vmax=255)
    ax.set(xticks=[], yticks=[], title=f"{title}, made up")
plt.show()

# %% [markdown]
# ## A plain folder
#
# Poses, the two descriptor files that VPR-methods-evaluation saves, and odometry in a format that
# you already have: here a TUM trajectory as any visual odometry writes it. The frames are a
# simulated world.

# %%
mine = Path("mine")
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
np.savetxt("odometry.tum", as_tum(world.query_poses), "%.9f")

# %% [markdown]
# On the command line: `taojax convert folder mine data --odometry odometry.tum --odometry-kind
# tum`. Public data sets have converters of their own: `taojax convert --help`.

# %%
words = ["convert", "folder", "mine", "data"]
converted = main([*words, "--odometry", "odometry.tum", "--odometry-kind", "tum"])
print(*sorted(str(path) for path in Path("data").rglob("*.*")), sep="\n")

# %% [markdown]
# ## Look before you judge
#
# `taojax inspect` checks every file and says in plain words what to expect.

# %%
inspected = main(["inspect", "data"])

# %% [markdown]
# Your own eyes see more than any check: the map, and how alike each query image finds each place
# (bright = alike; the dots are where it truly was).

# %%
alike = unit(world.query_descriptors) @ unit(world.map_descriptors).T
gap = world.query_poses[:, None, 1:3] - world.map_poses[None, :, 1:3]
figure, (left, right) = plt.subplots(1, 2, figsize=(9, 4), layout="constrained")
left.plot(*world.map_poses[:, 1:3].T, ".", color="#999999", markersize=4, label="map")
left.plot(*world.query_poses[:, 1:3].T, color="#0072B2", linewidth=1.0, label="query")
left.set(xlabel="x [m]", ylabel="y [m]", aspect="equal", title="simulated")
left.legend(frameon=False)
right.imshow(alike, cmap="gray", aspect="auto", interpolation="nearest")
right.plot(np.hypot(*gap.T).argmin(axis=0), np.arange(len(alike)), ".", color="#D55E00",
           markersize=2)  # fmt: skip
right.set(xlabel="map image", ylabel="query frame", title="similarity [1]")
plt.show()

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
from taojax.audit.evaluate import evaluate
from taojax.config import AuditConfig, Config
from taojax.datasets.progress import ProgressConfig, route_of_shares, write_progress
from taojax.plots import signal_trace
from taojax.runtime.score import score

rng = np.random.default_rng(1)
steps = rng.normal(size=(304, 32))
places = sum(steps[k : k + 300] for k in range(5)).astype(np.float32)
seen = (places + rng.normal(0, 3.5, places.shape)).astype(np.float32)

# %%
route = Path("route")
write_progress(route, route_of_shares(places, seen), ProgressConfig(), seed=0)
config = Config(audit=AuditConfig(r_in_m=2.0, r_out_m=10.0, n_bootstrap=50))  # rows
score(route, Path("run"), config)
found = evaluate(Path("run"), route / "truth", config)
print(*found.sentences, sep="\n")

# %% [markdown]
# `read_run` hands out all tables of a run folder, whoever wrote it, as pandas: `signals`, `labels`
# and `verdicts` by frame, `metrics` by signal. The similarity gates, the literal cost and `tao`,
# over all labelled frames:

# %%
run = read_run("run")
run.metrics.loc[["top1", "top1_w10", "tao_rank", "tao"], ["auroc", "aupr_out", "far_at_95"]].round(
    3
)

# %% [markdown]
# What was decided (rows) of what truly was (columns), on the second half:

# %%
frames = run.labels.join(run.verdicts)
frames[frames["split"] == "test"].groupby(["verdict", "label"]).size().unstack(fill_value=0)

# %%
figure, ax = plt.subplots(figsize=(9, 3), layout="constrained")
is_out, half = (
    (run.labels["label"] == "map_out").to_numpy(),
    run.labels["split"].eq("test").argmax(),
)
level = float(run.metrics.loc["tao", "threshold"])
signal_trace(run.signals["tao"].to_numpy(), is_out, name="tao [1]", threshold=level,
             test_start=int(half), ax=ax)  # fmt: skip
ax.set(xlabel="query frame", title="simulated odometry, made-up descriptors")
ax.legend(frameon=False, fontsize=8, ncols=4)
plt.show()

# %% [markdown]
# A straight window is not a degenerate one: every frame after the first two has an answer. Its
# volume is zero by nature, so that `c_geom` and `h_proxy` say nothing on a route.

# %%
run.signals["status"].value_counts()

# %%
run.metrics.loc[["c_geom", "h_proxy"], ["auroc"]]
