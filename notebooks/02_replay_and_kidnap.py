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
# # 2. Streaming replay and the kidnapped robot
#
# A whole log is one `lax.scan` over the same `step`; many logs are a `vmap` of that scan. Here the
# robot is carried elsewhere again and again, and its odometry does not notice.

# %%
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

from taojax import STATUSES, Config, Frame, map_tables, replay
from taojax.audit.recovery import frames_to_recovery
from taojax.datasets.kidnap import Plan, make_logs, world_source
from taojax.datasets.simulate import WorldConfig
from taojax.runtime.retrieval import retrieve

# %% [markdown]
# Logs are spliced from stretches of the simulated query drive. Into the first frame of a stretch
# leads the motion that belonged to it, so odometry has no gap; noise grows with the distance.

# %%
source = world_source(WorldConfig(offset_cap_m=4.0), seed=0)
logs = make_logs(source, Plan(n_trials=12), seed=0, levels=("medium",))
print(f"{len(logs)} logs of {len(logs[0].rows)} frames; jumps of the first: {logs[0].kidnaps}")

# %%
index, similarity = retrieve(source.map_views, source.query_views[0])
rows = np.stack([log.rows for log in logs])
odometry = jnp.asarray(np.stack([log.odometry for log in logs]), jnp.float32)
frames = Frame(odometry, jnp.asarray(index[rows]), jnp.asarray(similarity[rows]))
tables = map_tables(source.map_poses[:, 1:], descriptors=source.map_views)
_, records = jax.vmap(lambda log: replay(Config(), tables, log))(frames)

# %% [markdown]
# How long until the pose is within 10 m of the truth and stays there for ten frames?

# %%
pose = np.asarray(records.pose)
error = np.hypot(*np.moveaxis(pose[..., :2] - source.query_poses[rows][..., 1:3], -1, 0))
found = []
for log, distance in zip(logs, error, strict=True):
    for start, end in zip(log.kidnaps, [*log.kidnaps[1:], len(log.rows)], strict=True):
        if start <= len(log.rows) - 20:
            found.append(frames_to_recovery(distance[start:end] <= 10.0, 10))
print(f"{np.isfinite(found).mean():.0%} of {len(found)} recovered, median {np.median(found):.0f}")

# %% [markdown]
# Between the jump and the recovery nothing may be believed: the frames do not fit on the path of
# the old answer, and `tao` is high. The first log, with its jumps dashed:

# %%
status = np.array(STATUSES)[np.asarray(records.status)]
believed = (status == "ok") & (np.asarray(records.signals["tao"]) < 0.3)
figure, ax = plt.subplots(figsize=(9, 3), layout="constrained")
ax.semilogy(error[0] + 0.1, color="#0072B2", linewidth=1.0)
ax.plot(np.flatnonzero(believed[0]), error[0][believed[0]] + 0.1, ".", color="#009E73")
for jump in logs[0].kidnaps:
    ax.axvline(jump, color="#D55E00", linestyle="--", linewidth=1.0)
ax.set(xlabel="frame of the log", ylabel="error [m]", title="simulated; green: may be believed")
plt.show()

# %%
wrong = float((believed & (error > 10.0)).sum() / len(found))
print(f"{wrong:.2f} wrong frames that may be believed per kidnap")

# %% [markdown]
# The whole experiment, with rivals, three levels of drift and a report: `taojax kidnap`.
