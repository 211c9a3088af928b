"""Every number a user may turn, with its unit and its legal range."""

import dataclasses
import math
import tomllib
from pathlib import Path
from typing import Any

import equinox as eqx
from jaxtyping import Array, Float

from taojax.errors import ConfigError

Scalar = float | int | Float[Array, ""]


def _check_range(name: str, value: object, low: float | int, high: float | int = math.inf) -> None:
    # Traced values (a sweep under vmap) carry no number to check; their author checked the grid.
    if isinstance(value, int | float) and not (low <= value < high):
        raise ConfigError(f"{name} must lie in [{low:g}, {high:g}), got {value!r}")


class StreamConfig(eqx.Module):
    """How a stream of retrievals becomes signals; everything the robot side may know.

    Fields marked *shape* set array sizes: changing one recompiles. The others may also be
    scalar arrays, so that a sweep over them is a `vmap`, not a loop over compilations.
    """

    window: int = eqx.field(static=True, default=20)
    """*shape*. Frames remembered (the paper's N), at least 3."""

    branches: int = eqx.field(static=True, default=100)
    """*shape*. Hypotheses evaluated at once (the paper's K), at least 1."""

    association: str = eqx.field(static=True, default="joint")
    """*shape*. What `tao` and the pose are of: `rank`, the paper's literal branches, which are
    always there as `tao_rank`; `joint`, the filter's answer, whose path through the map associates
    all frames at once."""

    lambda_velocity: Scalar = 1.0
    """Weight of the velocity term of Eq. 1, dimensionless, >= 0."""

    gamma_similarity: Scalar = 1.0
    """Weight of the similarity term of Eq. 1, m^2 per unit of similarity, >= 0."""

    tau_masks: Scalar = 1.0
    """Geometric cost of a frame without a candidate, in units of the Huber cost at the residual
    mask, >= 0: no support is as bad as support at the mask. Its similarity counts as 0."""

    delta_spacings: Scalar = 3.0
    """Huber threshold as a multiple of the map's median spacing, > 0."""

    mask_deltas: Scalar = 3.0
    """Residual mask as a multiple of the Huber threshold, > 0."""

    refine: bool = eqx.field(static=True, default=False)
    """*shape*. Take Eq. 1 of rank branches at its true Huber minimum instead of the closed form:
    `tao_rank` and its terms change, and a frame takes about a millisecond longer."""

    entropy_temperature: Scalar = 0.05
    """Softmax temperature of the entropy signal, similarity units, > 0."""

    eps: Scalar = 1e-12
    """Keeps A_aniso and H_proxy finite, in the units of their singular values."""

    def __check_init__(self) -> None:
        """Refuse impossible settings while the caller's line is on the stack."""
        _check_range("window", self.window, 3, 10_001)
        _check_range("branches", self.branches, 1, 1_000_001)
        if self.association not in ("rank", "joint"):
            raise ConfigError(f"association must be rank or joint, got {self.association!r}")
        for name in ("lambda_velocity", "gamma_similarity", "tau_masks"):
            _check_range(name, getattr(self, name), 0.0)
        for name in ("delta_spacings", "mask_deltas", "entropy_temperature", "eps"):
            _check_range(name, getattr(self, name), 1e-30)


class VerdictConfig(eqx.Module):
    """The filter over the map's anchors that says whether an answer is right; robot side.

    Lengths are in gaps (median distance between neighbouring map poses), so that a map in other
    units gives the same verdicts. Each default was set by leaving whole recordings out
    (`python -m benchmarks verdict`).
    """

    lag: int = eqx.field(static=True, default=20)
    """*shape*. Frames that a final verdict may wait for, 0 to 1,000. Where frames are dense (less
    than half a gap apart) it is what travels as far, up to five times as many frames."""

    window_frames: int = eqx.field(static=True, default=20)
    """*shape*. Frames on either side by which an answer is tried, counted as the lag is, 4 to
    1,000; a short window is a quarter of it, a long one reaches three times as far back."""

    evidence: Scalar = 4.0
    """Log likelihood ratio of a strong match against background, per whole piece of evidence,
    > 0."""

    leave: Scalar = 0.02
    """Probability of leaving the map per unit of way, in (0, 1)."""

    come_back: Scalar = 0.1
    """Probability of coming back onto it, anywhere, per unit of way, in (0, 1)."""

    start_off: Scalar = 0.3
    """Probability of starting off the map, in (0, 1)."""

    step_gaps: Scalar = 1.0
    """Motion is gathered up to so many gaps before the belief moves, > 0."""

    reach_gaps: Scalar = 2.0
    """Who would have come from farther than this from every anchor came from off the map, > 0."""

    place_gaps: Scalar = 4.0
    """Hypotheses within so many gaps of the likeliest are one place, > 0."""

    near_gaps: Scalar = 2.0
    """A candidate this near to where an answer predicts it agrees with the answer, gaps, > 0."""

    drift: Scalar = 0.05
    """That distance grows by this share of the way driven in between, >= 0."""

    history_gaps: Scalar = 100.0
    """Trusted answers fade by a factor e over so many gaps of way, > 0. From 60 to 150 nothing
    changes by more than .01 in recall or wrong share; without fading .05 less is accepted, because
    odometry drifts and a kidnapped robot is never believed again."""

    def __check_init__(self) -> None:
        """Refuse impossible settings while the caller's line is on the stack."""
        _check_range("lag", self.lag, 0, 1001)
        _check_range("window_frames", self.window_frames, 4, 1001)
        for name in ("leave", "come_back", "start_off"):
            _check_range(name, getattr(self, name), 1e-9, 1.0)
        for name in ("evidence", "step_gaps", "reach_gaps", "place_gaps", "near_gaps",
                     "history_gaps"):  # fmt: skip
            _check_range(name, getattr(self, name), 1e-9)
        _check_range("drift", self.drift, 0.0)


class AuditConfig(eqx.Module):
    """How the judge labels, splits and measures; nothing here reaches the robot side."""

    r_in_m: float = 10.0
    """A query nearer than this to a map pose is in-map, metres, > 0."""

    r_out_m: float = 10.0
    """A query farther than this from every map pose is map-out, metres, >= r_in_m."""

    calibration_share: float = 0.5
    """Share of the frames, from the start, that thresholds may be fitted on, in (0, 1)."""

    sigmas: float = 3.0
    """The paper's rule: threshold = mean + sigmas * standard deviation of in-map costs."""

    alpha: float = 0.2
    """False acceptance rate that the conformal threshold promises at most, in (0, 1)."""

    confidence: float = 0.9
    """Share of recordings in which that promise holds, at least, in (0, 1)."""

    n_bootstrap: int = 300
    """Block-bootstrap resamples behind each interval, at least 10."""

    block_frames: int = 40
    """Length of a bootstrap block in frames: twice the window, so that windows stay whole."""

    max_wrong: float = 0.05
    """Share of the accepted answers that may be wrong, in (0, 1)."""

    def __check_init__(self) -> None:
        """Refuse impossible settings while the caller's line is on the stack."""
        _check_range("r_in_m", self.r_in_m, 1e-9)
        _check_range("r_out_m", self.r_out_m, 1e-9)
        if self.r_out_m < self.r_in_m:
            raise ConfigError(f"r_out_m ({self.r_out_m}) must be >= r_in_m ({self.r_in_m})")
        _check_range("calibration_share", self.calibration_share, 0.01, 0.99)
        _check_range("sigmas", self.sigmas, 0.0)
        _check_range("alpha", self.alpha, 1e-6, 1.0)
        _check_range("confidence", self.confidence, 1e-6, 1.0)
        _check_range("n_bootstrap", self.n_bootstrap, 10, 100_001)
        _check_range("block_frames", self.block_frames, 1)
        _check_range("max_wrong", self.max_wrong, 1e-6, 1.0)

    @property
    def wrong_m(self) -> float:
        """Return how far from the truth an answer must lie to be wrong, metres.

        Not below 2 r_in: a right answer may be off by the distance between the two sessions' tracks
        and half a map spacing besides, which r_in stands for.
        """
        return max(self.r_out_m, 2.0 * self.r_in_m)


class Config(eqx.Module):
    """One run, fully described."""

    stream: StreamConfig = StreamConfig()
    verdict: VerdictConfig = VerdictConfig()
    audit: AuditConfig = AuditConfig()
    seed: int = eqx.field(static=True, default=0)
    """Seeds the simulated world and the bootstrap."""

    def __check_init__(self) -> None:
        """Refuse seeds that no generator takes."""
        _check_range("seed", self.seed, 0, 2**63)


_GONE = {"joint_window", "joint_seeds", "memory_frames", "kappa_spacings"}
"""Settings of the joint branches, which runs sealed by earlier builds hold."""

_PARTS = {"stream": StreamConfig, "verdict": VerdictConfig, "audit": AuditConfig}
"""Tables of a settings file."""


def replace(config: Config, changes: dict[str, Any]) -> Config:
    """Return `config` with some fields changed, wherever in the tree they live.

    Args:
        config: the settings to start from.
        changes: field name -> value; `None` keeps the old value.

    Raises:
        ConfigError: a value is out of range or a name is unknown.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    parts = {name: getattr(config, name) for name in _PARTS}
    for part, module in parts.items():
        mine = {f.name: given.pop(f.name) for f in dataclasses.fields(module) if f.name in given}
        parts[part] = dataclasses.replace(module, **mine)
    seed = given.pop("seed", config.seed)
    if given:
        raise ConfigError(f"unknown setting(s): {', '.join(sorted(given))}")
    return Config(seed=seed, **parts)


def _typed(name: str, value: object, default: object) -> object:
    """Return a TOML value as the type of its default, or say which type is wanted."""
    if isinstance(value, int) and isinstance(default, float) and not isinstance(value, bool):
        return float(value)
    if type(value) is not type(default):
        want, got = type(default).__name__, type(value).__name__
        raise ConfigError(f"{name}: expected {want}, got {got} {value!r}")
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """Read a file of settings.

    Raises:
        ConfigError: it cannot be read, or is not TOML.
    """
    try:
        if path.exists() and not path.is_file():
            raise OSError("is not a file")
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(f"{path}: cannot be read as TOML: {error}") from error


def from_toml(path: Path) -> Config:
    """Read settings; what the file leaves out keeps its default.

    Raises:
        ConfigError: unreadable file, unknown table or key, wrong type, value out of range.
    """
    parts: dict[str, Any] = {}
    for name, value in read_toml(path).items():
        if name == "seed":
            parts[name] = _typed(name, value, 0)
            continue
        cls = _PARTS.get(name)
        if cls is None or not isinstance(value, dict):
            known = ", ".join(f"[{part}]" for part in _PARTS)
            raise ConfigError(f"{path}: unknown entry {name!r}; known: seed, {known}")
        defaults = {f.name: f.default for f in dataclasses.fields(cls)}
        unknown = sorted(set(value) - set(defaults))
        if unknown:
            gone = " of an earlier build: delete them, or score the data again"
            hint = gone if set(unknown) <= _GONE else ""
            raise ConfigError(f"{path}: unknown key(s) in [{name}]: {', '.join(unknown)}{hint}")
        try:
            parts[name] = cls(**{k: _typed(k, v, defaults[k]) for k, v in value.items()})
        except ConfigError as error:
            raise ConfigError(f"{path}: [{name}] {error}") from error
    try:
        return Config(**parts)
    except ConfigError as error:
        raise ConfigError(f"{path}: {error}") from error


def to_toml(config: Config) -> str:
    """Return the settings as TOML that `from_toml` reads back unchanged."""
    lines = [f"seed = {config.seed}"]
    for name in _PARTS:
        module = getattr(config, name)
        lines.append(f"\n[{name}]")
        for field in dataclasses.fields(module):
            value = getattr(module, field.name)
            text = f'"{value}"' if isinstance(value, str) else repr(value)
            text = text.lower() if isinstance(value, bool) else text
            lines.append(f"{field.name} = {text}")
    return "\n".join(lines) + "\n"
