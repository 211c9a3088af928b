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
# # When geometry helps, and when it cannot
#
# Two simulated worlds with the same road and the same deleted map segments. In the first the
# similarity *level* separates: what is off the map looks like nothing in it. In the second places
# alias: what is off the map looks exactly like somewhere else. A similarity gate can only work in
# the first. The path of the filter's answer (`tao`) works in both, as long as the odometry
# disagrees with the alias.

# %%
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from sklearn.metrics import roc_auc_score

from taojax import Config, Frame, map_tables, replay
from taojax.datasets.edit import scenario
from taojax.datasets.simulate import WorldConfig, make_world
from taojax.runtime.retrieval import retrieve

SIGNALS = ("top1", "top1_w10", "tao_rank", "tao")


# %%
def replayed(world):
    found = retrieve(world.map_descriptors, world.query_descriptors)
    tables = map_tables(world.map_poses[:, 1:], descriptors=world.map_descriptors)
    odometry = jnp.asarray(world.odometry[:, 1:], jnp.float32)
    return replay(Config(), tables, Frame(odometry, *(jnp.asarray(a) for a in found)))[1]


# %%
def off_map(world):
    gap = world.query_poses[:, None, 1:3] - world.map_poses[None, :, 1:3]
    return np.sqrt((gap**2).sum(-1)).min(axis=1) > 10.0


# %% [markdown]
# One command makes a world; `alias` says how much of the appearance is shared between places.

# %%
worlds = {
    "level separates": scenario(make_world(WorldConfig(alias=0.05), 100), "h4"),
    "places alias": scenario(make_world(WorldConfig(alias=0.7, common=0.2), 100), "h4"),
}
records = {name: replayed(world) for name, world in worlds.items()}
truth = {name: off_map(world) for name, world in worlds.items()}

# %% [markdown]
# The area under the ROC curve of each signal, over all frames (simulated):

# %%
scores = pd.DataFrame({
    name: {s: roc_auc_score(truth[name], records[name].signals[s]) for s in SIGNALS}
    for name in worlds
})  # fmt: skip
scores.round(3)

# %% [markdown]
# The same as a picture: grey is off the map. Where places alias, the similarity does not move when
# the robot leaves the map; the cost along the path does.

# %%
figure, axes = plt.subplots(2, 2, figsize=(9, 6), sharex=True, layout="constrained")
for row, name in zip(axes.T, worlds, strict=True):
    for ax, signal in zip(row, ("top1_w10", "tao"), strict=True):
        ax.plot(records[name].signals[signal], linewidth=1.0, color="#0072B2")
        ax.fill_between(range(len(truth[name])), 0, 1, where=truth[name], color="#999999",
                        alpha=0.3, transform=ax.get_xaxis_transform(), linewidth=0)  # fmt: skip
        ax.set(ylabel=f"{signal} [1]", title=name if signal == "top1_w10" else "")
    ax.set_xlabel("query frame")
plt.show()

# %% [markdown]
# Where geometry cannot help: at a radius of a few metres. An answer that is wrong by less than the
# spread of the anchors bends no alignment, so no passive signal tells it from a right one.

# %%
name = "level separates"
error = np.hypot(*(records[name].pose[:, :2] - worlds[name].query_poses[:, 1:3]).T)
inside = ~truth[name] & records[name].has_pose
near = {s: roc_auc_score(error[inside] > 5.0, records[name].signals[s][inside]) for s in SIGNALS}
pd.Series(near).round(3)
