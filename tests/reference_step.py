"""A stream in plain NumPy and float64, frame by frame: what every signal of a step has to be.

It shares no line with the library but the map's tables: nearest anchors, cells, neighbours.
"""

import numpy as np
import reference
from conftest import loop, motions

T, M, K, N, H, SEEDS = 36, 60, 7, 6, 9, 4
LAMBDA, GAMMA, TAU, DELTAS, MASKS = 0.7, 25.0, 0.8, 1.7, 1.2
MEMORY, KAPPA, TEMPERATURE, EPS, RECALL = 4.0, 2.2, 0.11, 1e-3, 0.9
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
        self.xy, self.theta = np.asarray(tables.grid.xy, float), PLACES[:, 2]
        self.grid = {name: np.asarray(getattr(tables.grid, name)) for name in vars(tables.grid)}
        self.odometry, self.weight = odometry.astype(float), weight.astype(float)
        self.index, self.similarity = index, similarity.astype(float)
        self.poses = [np.zeros(3)]
        for motion in self.odometry[1:]:
            self.poses.append(moved(self.poses[-1], motion))
        gap = np.linalg.norm(self.xy[:, None] - self.xy[None], axis=2)
        self.gap = np.take_along_axis(gap, self.grid["neighbour"].T, axis=1)

    def rho(self, r):
        return np.where(r <= self.delta, r**2 / 2, self.delta * (r - self.delta / 2))

    def local(self, past, t):
        return (np.array(self.poses)[past, :2] - self.poses[t][:2]) @ turn(self.poses[t][2])

    def look_up(self, xy):
        cell = np.floor((xy - self.grid["corner"]) / self.grid["cell_m"]).astype(int)
        is_on = np.all((cell >= 0) & (cell < self.grid["shape"]), axis=-1)
        flat = np.where(is_on, cell[..., 0] * self.grid["shape"][1] + cell[..., 1], 0)
        return np.where(is_on, self.grid["nearest"][flat], -1)

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
        backwards = inside[posed][::-1]
        support = 1 - inside[posed].sum() / len(past)
        stale = np.argmax(backwards) if backwards.any() else N
        said = {"support": support, "stale": stale, "index": self.index[t, posed]}
        return row, said | {"pose": poses[posed], "is_second": posed != best}

    # Joint branches.

    def rescaled(self, t):
        row = np.zeros(M)
        there = self.index[t] >= 0
        row[self.index[t][there]] = np.clip((self.similarity[t][there] - 0.1) / 0.8, 0, 1)
        return row

    def find(self, past, p, pose):
        """Anchor of every frame, its position, and what its similarity costs."""
        near = self.look_up(p @ turn(pose[2]).T + pose[:2])
        anchor = np.full(len(past), -1)
        for i, t in enumerate(past):
            if near[i] >= 0:
                there = self.grid["neighbour"][:, near[i]]
                price = self.rho(self.gap[near[i]]) / self.delta**2 - self.rescaled(t)[there]
                anchor[i] = there[np.argmin(price)]
        return anchor

    def price(self, past, p, anchor, pose):
        similarity = np.array([self.rescaled(t)[a] for t, a in zip(past, anchor, strict=True)])
        r = reference.residuals(pose, p, self.xy[anchor])
        geom = np.where(anchor >= 0, self.rho(r) / self.delta**2, np.inf)
        return geom, 1 - similarity, r

    def follow(self, past, p, w, seed):
        pose, anchor = np.array(seed, float), self.find(past, p, seed)
        kappa = KAPPA * (self.spacing / self.delta) ** 2
        geom, sim, r = self.price(past, p, anchor, pose)
        on = np.where(geom + sim < 1, w / (np.maximum(r, self.delta) * self.delta), 0)
        if on.any():
            x, y = p @ [1, 1j], self.xy[anchor] @ [1, 1j]
            x0, y0 = (on @ x) / on.sum(), (on @ y) / on.sum()
            spin = np.sum(on * np.conj(x - x0) * (y - y0)) + kappa * np.exp(1j * seed[2])
            shift = y0 - x0 * spin / abs(spin)
            pose = np.array([shift.real, shift.imag, np.angle(spin)])
        fresh = self.find(past, p, pose)
        old, new = (sum(self.price(past, p, a, pose)[:2]) for a in (anchor, fresh))
        anchor = np.where(old <= new, anchor, fresh)
        geom, sim, _ = self.price(past, p, anchor, pose)
        each = np.minimum(1.0, geom + sim)
        cost = w @ each + kappa * (1 - np.cos(pose[2] - seed[2]))
        return {
            "cost": cost,
            "pose": pose,
            "anchor": anchor,
            "each": each,
            "geom": geom,
            "sim": sim,
        }

    def joint(self, t, carried):
        past = np.arange(max(0, t - H + 1), t + 1)
        w, p = np.exp(-(t - past) / MEMORY), self.local(past, t)
        w /= w.sum()
        seeds = [moved(carried, self.odometry[t])] if carried is not None else []
        for row in self.index[t, :SEEDS]:
            if row >= 0:
                seeds += [np.r_[self.xy[row], self.theta[row] + extra] for extra in (0, np.pi)]
        found = [self.follow(past, p, w, seed) for seed in seeds]
        best = min(found, key=lambda branch: branch["cost"])
        away = [np.linalg.norm(b["pose"][:2] - best["pose"][:2]) for b in found]
        rival = [b["cost"] for b, m in zip(found, away, strict=True) if m > 3 * self.delta]
        on = best["geom"] + best["sim"] < 1
        pair = on[1:] & on[:-1]
        dp, dq = np.diff(p, axis=0), np.diff(self.xy[best["anchor"]], axis=0)
        mismatch = np.sum((dq - dp @ turn(best["pose"][2]).T) ** 2, axis=1)
        return best["pose"], {
            "tao_window": best["cost"],
            "tao_geom": np.sum(w[on] * best["geom"][on]),
            "tao_sim": np.sum(w[on] * best["sim"][on]),
            "tao_vel": LAMBDA * (mismatch[pair].mean() if pair.any() else 0) / self.delta**2,
            "tao_rival": min([1.0, *rival]),
            "tao_align": lepski(best["each"][::-1]),
            "support": 1 - on.mean(),
        }

    # The filter on the map's graph.

    def recursive(self):
        """Yield the probability of not being where the belief is strongest."""
        mass, off = np.full((2, M), 0.7 / (2 * M)), 0.3
        near = self.grid["neighbour"].T
        for t in range(T):
            dx, dy, da = self.odometry[t]
            driven = np.hypot(dx, dy)
            doubt = 0.5 * self.spacing * min(1.0, driven / (0.5 * self.spacing))
            variance = doubt**2 + (0.1 * self.spacing) ** 2 + (0.15 * driven) ** 2
            kernel = np.exp(-(self.gap**2) / 2 / variance)
            spread = np.array([(kernel * side[near]).sum(1) / kernel.sum(1) for side in mass])
            arriving = np.zeros((2, M))
            for m in range(M):
                heading = self.theta[m] - da
                for side, sign in ((0, -1), (1, 1)):
                    before = self.xy[m] + sign * turn(heading) @ [dx, dy]
                    source = int(self.look_up(before))
                    gap = np.linalg.norm(self.xy[source] - before)
                    if source >= 0 and gap < 2 * self.spacing:
                        is_same = np.cos(self.theta[source] - heading) >= 0
                        arriving[side, m] = 0.98 * spread[side if is_same else 1 - side, source]
            gone = max(1 - off - arriving.sum(), 0)
            mass = (arriving + 0.1 * off / (2 * M)) * np.exp(8 * self.rescaled(t))
            off = 0.9 * off + gone
            mass, off = mass / (mass.sum() + off), off / (mass.sum() + off)
            here = self.xy[np.argmax(mass.sum(0))]
            local = np.linalg.norm(self.xy - here, axis=1) < 6 * self.spacing
            yield 1 - mass[:, local].sum()

    def rows(self):
        """Return what every frame says: signals, and the answer of the best rank branch."""
        carried, rows, answers = None, [], []
        for t, elsewhere in enumerate(self.recursive()):
            rank, answer = self.rank(t)
            carried, joint = self.joint(t, carried)
            joint |= {"recursive": elsewhere, "tao": joint["tao_align"] + RECALL**N * elsewhere}
            rows.append(self.frontend(t) | rank | joint)
            answers.append(answer)
        return rows, answers


def lepski(each):
    """Mean over the longest window whose interval meets those of all shorter ones."""
    lows, highs, kept = [], [], each[0]
    for length in (2, 3, 5, 8, 13, 20, 30, 45, 60):
        part = each[:length]
        n, mean = len(part), np.mean(part)
        shrunk = (part.sum() + 0.5) / (n + 1)
        half = 1.2 * max((4 * shrunk * (1 - shrunk)) ** 2, 0.05) / np.sqrt(n)
        lows.append(mean - half)
        highs.append(mean + half)
        if max(lows) > min(highs):
            return kept
        kept = mean
    return kept
