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
# # 1. Quickstart: one frame in, one verdict out
#
# A place-recognition frontend always answers. Here a simulated robot drives a road of which the map
# lacks some stretches; the frontend answers there as well. taojax looks at the last frames, aligns
# the answers with what odometry says, and tells whether they fit together.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from taojax import STATUSES, Frame, StreamConfig, init, map_tables, step
from taojax.datasets.edit import scenario
from taojax.datasets.simulate import WorldConfig, make_world
from taojax.runtime.retrieval import retrieve

world = scenario(make_world(WorldConfig(), seed=0), "default")

# %% [markdown]
# **Once per map**: tables for the look-ups. Lengths inside are in map spacings, so that one set of
# defaults serves a corridor and a street.

# %%
config = StreamConfig()
tables = map_tables(world.map_poses[:, 1:], config, world.map_descriptors)
print(f"{len(world.map_poses)} map images, {float(tables.spacing_m):.1f} m apart")

# %% [markdown]
# **Once per frame**: the motion since the frame before and the frontend's best answers. The state
# has a fixed shape, so nothing compiles twice and memory stays as it is for ever.

# %%
index, similarity = retrieve(world.map_descriptors, world.query_descriptors[:300])
odometry = world.odometry[:300, 1:].astype(np.float32)
state, records = init(config, tables), []
for motion, rows, values in zip(odometry, index, similarity, strict=True):
    frame = Frame(jnp.asarray(motion), jnp.asarray(rows), jnp.asarray(values))
    state, record = step(config, tables, state, frame)
    records.append(record)

# %% [markdown]
# What one record says: the place, how it got there, and every signal (larger = more likely off the
# map).

# %%
last = records[100]
print(STATUSES[int(last.status)], np.round(np.asarray(last.pose), 2), int(last.map_index))
{name: round(float(last.signals[name]), 3) for name in ("top1", "tao", "tao_rank", "support")}

# %% [markdown]
# `tao`, cost along the path of the filter's answer and doubt of its place, against the truth, which
# only this picture knows (grey: the nearest map image is more than 10 m away).

# %%
gap = world.query_poses[:300, None, 1:3] - world.map_poses[None, :, 1:3]
is_off = np.sqrt((gap**2).sum(-1)).min(axis=1) > 10.0
tao = np.array([float(record.signals["tao"]) for record in records])
figure, ax = plt.subplots(figsize=(9, 3), layout="constrained")
ax.plot(tao, color="#0072B2", linewidth=1.0)
ax.fill_between(range(300), 0, 1, where=is_off, color="#999999", alpha=0.3,
                transform=ax.get_xaxis_transform(), linewidth=0)  # fmt: skip
ax.set(xlabel="query frame", ylabel="tao [1]", title="simulated")
plt.show()

# %%
inside, outside = float(np.median(tao[~is_off])), float(np.median(tao[is_off]))
print(f"median tao on the map {inside:.2f}, off the map {outside:.2f}")
