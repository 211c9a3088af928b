"""What `taojax inspect` says of descriptors and retrieval lists."""

from typing import TYPE_CHECKING

import numpy as np

from taojax.runtime.likeness import chance, histogram, near_m, views
from taojax.verbs.inspect_page import Page, share
from taojax.verbs.inspect_truth import places

if TYPE_CHECKING:
    from taojax.audit.truth import Truth
    from taojax.runtime.checkup import Found
    from taojax.runtime.inspection import MapShape, Norms
    from taojax.runtime.likeness import Views
    from taojax.runtime.radii import Radii
    from taojax.verbs.inspect_truth import Places

BARELY, CLEAR = 0.04, 0.7
"""A recall so little above chance says that rows are mixed up; one above the other is good."""

BAR = 28
"""Characters of the longest bar."""


def lengths(page: Page, found: "Found") -> None:
    """Describe the lengths of descriptors and of lists."""
    page.head("descriptors" if found.norms else "retrieval lists")
    for name, of in found.norms.items():
        _norms(page, name, of)
    lists = found.observations.retrievals if found.observations else None
    if lists is None or found.map_t is None:
        return
    n = (lists.index >= 0).sum(axis=1)
    named = len(np.unique(lists.index[lists.index >= 0])) / len(found.map_t)
    page.say("candidates", f"{n.min()} to {n.max()} per query, median {np.median(n):.0f}")
    page.say("empty lists", f"{(n == 0).sum()} of {len(n):,}")
    page.say("map rows ever named", share(named))
    empty, median = float(np.mean(n == 0)), float(np.median(n))
    page.warn(empty > 0.2, f"{share(empty)} of the lists are empty: odometry has to bridge them")
    page.warn(
        0 < median < 5,
        f"lists hold {median:.0f} candidates (median): a true place that is not among them"
        " cannot be found",
    )


def _norms(page: Page, name: str, of: "Norms") -> None:
    side = "query" if "quer" in name else "map"
    page.say(f"length, {side}", f"{of.least:.3g} to {of.largest:.3g}, median {of.median:.3g}")
    is_sane = 1e-6 < of.median < 1e6 and of.largest < 1e9
    page.warn(
        not is_sane,
        f"{name}: rows of length {of.least:.3g} to {of.largest:.3g}: damaged, or bytes swapped?",
    )
    page.warn(
        is_sane and not 0.9 < of.median < 1.1,
        f"{name}: rows have a length of {of.median:.3g}; they are brought to 1 on loading",
    )
    for row in of.zero[:1]:
        where = f"{name}: {of.zero.size} row(s) of zeros, the first is row {row} (from 0)"
        page.warn(True, f"{where}; they resemble nothing")


def likeness(
    page: Page, found: "Found", truth: "Truth | None", shape: "MapShape", radii: "Radii"
) -> np.ndarray | None:
    """Say how far the frontend tells places apart and, with truth, how often it is right.

    Returns:
        (T,) metres from every query to the nearest map pose, where they are known.
    """
    if found.observations is None:
        return None
    xy, reach_m = found.observations.map_xyt[:, :2], near_m(shape.spacing_m)
    seen, blind = views(found.observations, xy, shape.spacing_m), chance(xy, reach_m)
    near = f"within {reach_m:.3g} m (9 spacings)"
    if (recall := seen.own_recall) is not None:
        page.say("map with itself", f"{share(recall)} of the images look most like one {near};"
                 f" by chance {share(blind)}")  # fmt: skip
        page.warn(
            recall <= blind + BARELY,
            "the map's images hardly look like their neighbours: do the rows of its descriptors"
            " follow map/poses.csv, or is it too sparse?",
        )
        page.warn(
            blind + BARELY < recall < CLEAR,
            f"descriptors tell apart only {share(recall)} of the map's own places:"
            " expect abstentions",
        )
    nearest_m = None
    if truth is not None and len(truth.t_s) == len(found.observations.t_s):
        where = places(seen, xy, truth.xy_m, reach_m)
        nearest_m = where.nearest_m
        _best_matches(page, where)
        _distances(page, nearest_m, radii)
    _similarities(page, seen)
    return nearest_m


def _best_matches(page: Page, where: "Places") -> None:
    if np.isfinite(where.right):
        page.say(
            "best match",
            f"{share(where.right)} lie within {where.near_m:.3g} m of the true position where the"
            f" map has an image there; by chance {share(where.chance)}",
        )
        page.warn(
            where.right <= where.chance + BARELY,
            "best matches are hardly more often right than by chance: do the rows of the query's"
            " descriptors follow query/odometry.csv?",
        )


def _distances(page: Page, nearest: np.ndarray, radii: "Radii") -> None:
    page.head("true positions")
    page.say(
        "nearest map pose",
        f"{np.median(nearest):.1f} m median, {np.quantile(nearest, 0.95):.1f} m at 95 %, at most"
        f" {nearest.max():.1f} m",
    )
    out_m = radii.r_out_m
    out = float(np.mean(nearest > out_m))
    page.say("off the map", f"{share(out)} of the queries lie farther than {out_m:g} m from it")
    page.warn(
        out == 0,
        f"every query lies within {out_m:g} m of the map: nothing is map-out and AUROC is not"
        " defined; choose a smaller --r-out, or cut the map",
    )
    page.warn(
        out == 1,
        f"no query lies within {out_m:g} m of the map: are map and truth in one frame?",
    )


def _similarities(page: Page, seen: "Views") -> None:
    """Draw how alike best matches and other pairs are."""
    if not len(seen.best_similarity) or not len(seen.others):
        return
    edges, best, others = histogram(seen.best_similarity, seen.others)
    name = "random pairs" if seen.own_recall is not None else "other candidates"
    top = max(best.max(), others.max())
    page.head("similarity")
    page.say("", f"{'best match':<{BAR + 2}}{name}")
    for low, high, a, b in list(zip(edges[:-1], edges[1:], best, others, strict=True))[::-1]:
        bars = [_bar(share / top) for share in (a, b)]
        page.say(f"{low:6.3f} to {high:6.3f}", f"{bars[0]:<{BAR + 2}}{bars[1]}")
    page.warn(
        float(np.median(seen.best_similarity)) <= float(np.quantile(seen.others, 0.9))
        and seen.own_recall is not None,
        "best matches are hardly more alike than random pairs",
    )


def _bar(share: float) -> str:
    """Return a bar; any share but none shows."""
    return "#" * int(np.ceil(share * BAR))
