"""What simulated places look like, and how two sessions see them.

Appearance lives on a periodic grid along the road. It mixes what only one place has, what its class
of places has and what all places have, so that descriptors alias as real ones do.
"""

import numpy as np

from taojax.datasets.world import WorldConfig

__all__ = ["CELL_M", "appearance", "at", "lengths", "map_view", "process", "query_view"]

CELL_M = 2.0
"""Spacing of every grid along the road."""

_DESCRIPTOR_GRID = 2.0**14  # descriptor values are multiples of its inverse


def appearance(rng: np.random.Generator, n_cells: int, config: WorldConfig) -> np.ndarray:
    """Draw the appearance of every cell of a road: its own, its class's and the common part."""
    own = process(rng, (n_cells, config.dimension), config.ell_m / CELL_M)
    patch = np.arange(n_cells) * CELL_M // config.alias_patch_m
    classes = rng.integers(config.n_alias, size=int(patch[-1]) + 1)
    faces = rng.standard_normal((config.n_alias, config.dimension))
    alias = _blur(
        faces[classes[patch.astype(np.int64)]],
        config.alias_blend_m / CELL_M,
        to_unit_variance=False,
    )
    everywhere = rng.standard_normal((1, config.dimension))
    share = 1.0 - config.alias - config.common
    return (
        np.sqrt(share) * own + np.sqrt(config.alias) * alias + np.sqrt(config.common) * everywhere
    )


def map_view(
    rng: np.random.Generator, field: np.ndarray, arc_m: np.ndarray, config: WorldConfig
) -> np.ndarray:
    """See a field from the given places in the map session's even light."""
    view = at(field, arc_m)
    return _descriptors(view + config.map_noise * rng.standard_normal(view.shape))


def query_view(
    rng: np.random.Generator, field: np.ndarray, arc_m: np.ndarray, config: WorldConfig
) -> np.ndarray:
    """See a field from about the given places, with noise that lasts and frames that fail."""
    n = len(arc_m)
    jitter_m = config.jitter_m * process(rng, (n, 1), config.jitter_frames)[:, 0]
    view = at(field, arc_m + jitter_m)
    level = np.exp(config.query_level_sd * process(rng, (n, 1), config.query_level_frames))
    noise = process(rng, view.shape, config.query_noise_frames)
    is_hard = rng.standard_normal((n, 1)) > config.hard_above
    hard = config.hard_noise * is_hard * rng.standard_normal(view.shape)
    return _descriptors(view + config.query_noise * level * noise + hard)


def _descriptors(view: np.ndarray) -> np.ndarray:
    unit = view / lengths(view)
    return (np.rint(unit * _DESCRIPTOR_GRID) / _DESCRIPTOR_GRID).astype(np.float32)


def _blur(values: np.ndarray, sigma: float, *, to_unit_variance: bool) -> np.ndarray:
    """Smooth periodic columns by a Gaussian; white noise of unit variance may keep its variance."""
    half = int(np.ceil(3.5 * sigma))
    taps = np.exp(-0.5 * (np.arange(half + 1) / max(sigma, 1e-9)) ** 2)
    total = taps**2 if to_unit_variance else taps
    scale = 2.0 * np.cumsum(total)[-1] - total[0]
    taps = taps / (np.sqrt(scale) if to_unit_variance else scale)
    n = len(values)
    padded = np.pad(values, ((half, half), (0, 0)), mode="wrap")
    out = taps[0] * values
    for k in range(1, half + 1):
        out += taps[k] * (padded[half - k : half - k + n] + padded[half + k : half + k + n])
    return out


def process(rng: np.random.Generator, shape: tuple[int, int], length: float) -> np.ndarray:
    """Draw periodic Gaussian processes of unit variance, one per column."""
    # White noise under a Gaussian of this width has the covariance exp(-d^2 / (2 length^2)).
    return _blur(rng.standard_normal(shape), length / np.sqrt(2.0), to_unit_variance=True)


def at(grid: np.ndarray, arc_m: np.ndarray) -> np.ndarray:
    """Interpolate the rows of a periodic grid linearly."""
    cell = np.floor(arc_m / CELL_M)
    share = (arc_m / CELL_M - cell)[:, None]
    low = cell.astype(np.int64) % len(grid)
    return (1.0 - share) * grid[low] + share * grid[(low + 1) % len(grid)]


def lengths(vectors: np.ndarray) -> np.ndarray:
    """Give the length of every row, as a column."""
    return np.sqrt(np.sum(vectors**2, axis=1, keepdims=True))
