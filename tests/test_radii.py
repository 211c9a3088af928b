"""Radii that inspect proposes: from the size of the map, never below spacing or drift."""

import dataclasses

import numpy as np
import pytest
from conftest import loop, motions

from taojax.cli.inspect_page import drift_m
from taojax.runtime import inspection
from taojax.runtime.inspection import suggest_radii


@pytest.fixture(scope="module")
def shapes():
    """Maps of 20, 100 and 1,000 m."""
    return {size: inspection.map_shape(loop(200, radius_m=size / 2.2)) for size in (20, 100, 1000)}


@pytest.mark.parametrize(
    ("size", "want"), [(20, (1.5, 3.0)), (100, (5.0, 10.0)), (1000, (20.0, 20.0))]
)
def test_radii_follow_the_size_of_the_map(shapes, size, want):
    assert suggest_radii(shapes[size])[:2] == want


def test_radii_are_never_below_spacing_or_drift(shapes):
    dense = dataclasses.replace(shapes[1000], spacing_m=1.0)
    assert suggest_radii(dense)[:2] == (10.0, 10.0)
    assert "raised to the map's spacing" in suggest_radii(shapes[1000]).why
    drifting = suggest_radii(shapes[20], 2.4)
    assert drifting[:2] == (3.0, 6.0)
    assert "raised to the drift" in drifting.why
    assert suggest_radii(shapes[100], 5.01)[:2] == (7.0, 10.0)
    assert suggest_radii(shapes[100], 7.1)[:2] == (10.0, 10.0)
    still = inspection.map_shape(np.zeros((5, 3)))
    assert suggest_radii(still)[:2] == (1.5, 3.0)


def test_radii_of_route_progress_count_map_spacings():
    line = np.c_[5.0 * np.arange(50), np.zeros((50, 2))]
    assert suggest_radii(inspection.map_shape(line))[:2] == (10.0, 50.0)


def test_drift_is_what_no_rigid_motion_explains():
    places = loop(80)
    odometry = np.zeros((80, 3))
    odometry[1:] = motions(places)[1:]
    turned = places[:, :2] @ np.array([[0.6, 0.8], [-0.8, 0.6]]) + 30.0
    assert drift_m(odometry, turned, 20) == pytest.approx(0.0, abs=1e-6)
    mirrored = places[:, :2] * [1.0, -1.0]
    assert drift_m(odometry, mirrored, 20) > 0.5
    line = np.c_[np.arange(80.0), np.zeros(80)]
    long = np.c_[np.full(80, 1.1), np.zeros((80, 2))]
    want = 0.1 * np.std(np.arange(20))
    assert drift_m(long, line, 20) == pytest.approx(want)
    assert drift_m(long[:3], line[:3], 20) < want
