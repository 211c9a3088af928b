"""Plots draw on the Axes they are given, with units, and leave the user's settings alone."""

import matplotlib
import numpy as np
import pytest
from matplotlib.figure import Figure

from taojax import plots
from taojax.plots import AXES_POINTS, LETTER, LINE, place_labels


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


@pytest.mark.parametrize(
    ("extent", "most"), [((500.0, 0.0), 3.5), ((500.0, 500.0), 8.0), ((0.0, 500.0), 8.0)]
)
def test_a_map_gets_a_figure_of_its_own_shape_and_keeps_all_of_it(extent, most, ax):
    points = np.stack([np.linspace(0, side, 50) for side in extent], axis=1)
    wide, high = plots.map_size(points)
    assert wide == 7.2
    assert 2.5 < high <= most
    plots.verdict_map(points, points, points, np.full(50, "accepted_in"), ax=ax)
    for side, limits in zip(extent, (ax.get_xlim(), ax.get_ylim()), strict=True):
        assert limits[0] < 0.0
        assert limits[1] > side
    # Nothing is a thread: the shorter side is a fair share of the longer one.
    spans = sorted(np.ptp(limits) for limits in (ax.get_xlim(), ax.get_ylim()))
    assert spans[0] > 0.2 * spans[1]


def test_the_legend_of_a_flat_map_stays_inside_the_figure():
    points = np.stack([np.linspace(0, 500, 7), np.zeros(7)], axis=1)
    figure = Figure(figsize=plots.map_size(points), layout="constrained")
    kinds = np.array([*plots.OUTCOMES, "accepted_in"])
    ax = plots.verdict_map(points, points, points, kinds, ax=figure.subplots())
    figure.draw_without_rendering()
    box = ax.get_legend().get_window_extent()
    label = ax.xaxis.label.get_window_extent()
    assert box.y0 >= 0.0
    assert box.y1 <= label.y0


def test_labels_hide_neither_one_another_nor_what_they_name():
    at = np.full((5, 2), 0.5 * AXES_POINTS) + np.array([[3.0 * i, 2.0 * i] for i in range(5)])
    texts = [f"{i + 1}: 0.9{i}" for i in range(5)]
    middle = at + place_labels(at, texts, at)
    half = 0.5 * np.array([LETTER * len(texts[0]), LINE])
    for i, one in enumerate(middle):
        assert not any(np.all(np.abs(one - spot) < half) for spot in at)
        for other in middle[:i]:
            assert not np.all(np.abs(one - other) < 2.0 * half)


def test_labels_at_the_edge_stay_in_the_panel():
    at = np.array([[2.0, 2.0], [AXES_POINTS - 2.0, AXES_POINTS - 2.0]])
    middle = at + place_labels(at, ["1: 0.10", "2: 0.20"], at)
    assert np.all(middle > 0.5 * LINE)
    assert np.all(middle < AXES_POINTS - 0.5 * LINE)


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
