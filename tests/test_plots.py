"""Plots draw on the Axes they are given, with units, and leave the user's settings alone."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from taojax import plots


@pytest.fixture
def ax():
    return Figure().subplots()


DRAWN = {
    "retrieval": lambda ax: plots.retrieval_curve({2.5: np.linspace(0, 1, 100)}, ax=ax),
    "trace": lambda ax: plots.signal_trace(
        np.array([1.0, np.nan, 3.0]), np.array([False, True, True]), name="tao [m^2]",
        threshold=2.0, test_start=1, ax=ax,
    ),
    "map": lambda ax: plots.verdict_map(
        np.zeros((4, 2)), np.ones((3, 2)), np.full((3, 2), 2.0),
        np.array(["accepted_in", "accepted_wrong", "grey"]), ax=ax,
    ),
    "roc": lambda ax: plots.curves(
        {"tao": (np.array([0.0, 1.0]), np.array([0.0, 1.0]))}, x="FRR", y="1 - FAR", ax=ax
    ),
    "reliability": lambda ax: plots.reliability_diagram(
        np.array([0.1, 0.9]), np.array([0.2, 0.8]), np.array([5, 6]), ax=ax
    ),
    "scenarios": lambda ax: plots.scenario_dots(
        {"tao": np.array([[0.9, 0.8, 1.0]])}, ("h3",), reference={"tao": np.array([0.976])},
        label="AUROC", ax=ax,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", DRAWN)
def test_a_plot_returns_the_axes_it_drew_on(name, ax):
    assert DRAWN[name](ax) is ax
    assert ax.has_data()
    assert ax.get_ylabel()


@pytest.mark.parametrize("name", DRAWN)
def test_a_plot_leaves_global_settings_alone(name, ax):
    before = dict(matplotlib.rcParams)
    DRAWN[name](ax)
    assert dict(matplotlib.rcParams) == before


def test_map_axes_are_metres_at_equal_scale(ax):
    DRAWN["map"](ax)
    assert ax.get_xlabel() == "x [m]"
    assert ax.get_aspect() == 1.0


def test_map_out_frames_are_shaded_and_the_threshold_is_drawn(ax):
    plots.signal_trace(
        np.arange(6.0), np.array([0, 1, 1, 0, 1, 0], dtype=bool), name="tao",
        threshold=4.5, test_start=3, ax=ax,
    )  # fmt: skip
    assert len(ax.patches) == 2
    assert [4.5, 4.5] in [list(line.get_ydata()) for line in ax.lines]


def test_a_signal_without_a_finite_value_is_drawn_empty(ax):
    drawn = plots.signal_trace(
        np.full(4, np.nan), np.zeros(4, bool), name="fused", threshold=np.nan, test_start=2, ax=ax
    )
    assert drawn is ax


def test_every_outcome_has_its_own_marker_and_colour():
    assert len({mark.marker for mark in plots.OUTCOMES.values()}) == len(plots.OUTCOMES)
    assert len({mark.colour for mark in plots.OUTCOMES.values()}) == len(plots.OUTCOMES)
