"""The literal stream in plain NumPy and float64: what every signal of a step has to be.

It shares no line with the library but the map's positions and spacing.
"""

import numpy as np
import reference
from conftest import loop, motions

T, M, K, N = 36, 60, 7, 6
LAMBDA, GAMMA, TAU, DELTAS, MASKS = 0.7, 25.0, 0.8, 1.7, 1.2
TEMPERATURE, EPS = 0.11, 1e-3
PLACES = loop(M)
PLACES[18:27, 2] += np.pi  # a stretch that the map drove the other way


def made(seed):
    """A noisy drive: odometry, lists with holes and one without any, weights of all sizes."""
    rng, queries = np.random.default_rng(seed), loop(T)
    away = np.linalg.norm(queries[:, None, :2] - PLACES[None, :, :2], axis=2)
    rows = np.exp(-away / 10) + rng.normal(0, 0.2, away.shape)
    index = np.argsort(-rows, axis=1)[:, :K].astype(np.int32)
    similarity = np.clip(np.take_along_axis(rows, index, 1), -1, 1)
    index[::5, 2:5], index[17], index[[13, 23, 29], :2] = -1, -1, -1
    odometry = motions(queries) + rng.normal(0, [0.3, 0.1, 0.03], (T, 3))
    weight = rng.uniform(0.2, 3, T)
    weight[11] = 0.0
    similarity = np.where(index < 0, 0, similarity)
    return odometry.astype("f4"), index, similarity.astype("f4"), weight.astype("f4")


def turn(angle):
    return np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])


def moved(pose, motion):
    return np.r_[pose[:2] + turn(pose[2]) @ motion[:2], pose[2] + motion[2]]


class Stream:
    """What NumPy says of every frame."""

    def __init__(self, tables, odometry, index, similarity, weight):
        self.spacing = float(tables.spacing_m)
        self.delta, self.mask = DELTAS * self.spacing, DELTAS * MASKS * self.spacing
        self.xy = np.asarray(tables.places.grid.xy, float)
        self.odometry, self.weight = odometry.astype(float), weight.astype(float)
        self.index, self.similarity = index, similarity.astype(float)
        self.poses = [np.zeros(3)]
        for motion in self.odometry[1:]:
            self.poses.append(moved(self.poses[-1], motion))

    def rho(self, r):
        return np.where(r <= self.delta, r**2 / 2, self.delta * (r - self.delta / 2))

    def local(self, past, t):
        return (np.array(self.poses)[past, :2] - self.poses[t][:2]) @ turn(self.poses[t][2])

    # What the frontend says.

    def frontend(self, t):
        s, there = self.similarity[t], self.index[t] >= 0
        row = {"top1": 1 - s[0], "margin": s[1] - s[0]}
        for n in (5, 10, 20):
            row[f"top1_w{n}"] = np.mean(1 - self.similarity[max(0, t - n + 1) : t + 1, 0])
        if not there.any():
            extent = np.sqrt(np.mean(np.sum((self.xy - self.xy.mean(0)) ** 2, axis=1)))
            return row | {"entropy": np.log(K), "velocity": extent, "sue": extent**2}
        share = np.exp(s[there] / TEMPERATURE) / np.exp(s[there] / TEMPERATURE).sum()
        near = np.exp(20 * s[there]) / np.exp(20 * s[there]).sum()
        xy = self.xy[self.index[t][there]]
        row["entropy"], row["velocity"] = -np.sum(share * np.log(share)), 0.0
        row["sue"] = np.sum(near @ (xy - near @ xy) ** 2)
        if t and self.index[t - 1, 0] >= 0 and self.index[t, 0] >= 0:
            jump = np.linalg.norm(xy[0] - self.xy[self.index[t - 1, 0]])
            row["velocity"] = abs(jump - np.linalg.norm(self.odometry[t, :2]))
        return row

    # Eq. 1 of every rank branch.

    def rank(self, t):
        past, there = np.arange(max(0, t - N + 1), t + 1), self.index[t] >= 0
        w, p = self.weight[past] / self.weight[past].sum(), self.local(past, t)
        tau = TAU * self.rho(np.array(self.mask))
        terms, poses, shapes, inside = [], [], [], []
        for k in range(K):
            has = (self.index[past, k] >= 0) & (w > 0)
            q = np.where(has[:, None], self.xy[self.index[past, k]], 0.0)
            found = (tau, 0.0, GAMMA, np.zeros(3))
            if has.any():
                found = reference.masked_cost(
                    p, q, self.similarity[past, k], has, w,
                    lam=LAMBDA, gamma=GAMMA, tau=tau, delta=self.delta, mask=self.mask,
                )  # fmt: skip
            terms.append(found[:3])
            poses.append(found[3])
            inside.append(has & (reference.residuals(found[3], p, q) <= self.mask))
            own = np.where(has, w, 0.0)
            h = reference.covariance(p, q, own)[0] * own.sum() if has.any() else np.zeros((2, 2))
            shapes.append(np.linalg.svd(h, compute_uv=False))
        total = np.sum(terms, axis=1)
        best = int(np.argmin(total))
        row = {"tao_rank": total[best]}
        row |= {
            f"tao_rank_{n}": x for n, x in zip(("geom", "vel", "sim"), terms[best], strict=True)
        }
        posed = int(np.argmin(np.where(there | ~there.any(), total, np.inf)))
        s1, s2 = shapes[posed]
        row |= {"c_geom": s1 * s2, "a_aniso": -s1 / (s2 + EPS), "h_proxy": np.log(s1 * s2 + EPS)}
        support = 1 - inside[posed].sum() / len(past)
        said = {"support": support, "index": self.index[t, posed]}
        return row, said | {"pose": poses[posed], "is_second": posed != best}

    def rows(self):
        """Return what every frame says: signals, and the answer of the best rank branch."""
        rows, answers = [], []
        for t in range(T):
            rank, answer = self.rank(t)
            rows.append(self.frontend(t) | rank | {"support": answer["support"]})
            answers.append(answer)
        return rows, answers
