"""Figures on real recordings that the field can check; skipped where they are absent."""

import numpy as np
import pytest

from taojax.audit import labels, metrics
from taojax.audit.labels import read_truth
from taojax.runtime.observations import load_observations
from taojax.runtime.score import candidates

# name, r_in [m], r_out [m], AUROC of top1, of its mean over ten frames
KNOWN = [
    ("mit_corridor", 5.0, 10.0, 0.775, 0.854),
    ("intel_lab", 1.5, 3.0, 0.644, 0.635),
    ("tuc_corridor_mapout", 2.0, 4.0, 0.915, 0.962),
]


@pytest.mark.parametrize(("name", "r_in", "r_out", "top1", "top1_w10"), KNOWN)
def test_similarity_gates_reach_their_known_auroc(shared, name, r_in, r_out, top1, top1_w10):
    observations = load_observations(shared / name)
    _, similarity = candidates(observations)
    truth = read_truth(shared / name / "truth", len(similarity))
    map_m = np.stack([observations.map_poses[c] for c in ("x_m", "y_m")], axis=1)
    label = labels.label_frames(labels.nearest_map_distance(truth.xy_m, map_m), r_in, r_out)
    known, is_out = label != "grey", label == "map_out"
    signal = 1.0 - similarity[:, 0].astype(float)
    mean = np.array([signal[max(0, t - 9) : t + 1].mean() for t in range(len(signal))])
    assert metrics.auroc(signal[known], is_out[known]) == pytest.approx(top1, abs=0.002)
    assert metrics.auroc(mean[known], is_out[known]) == pytest.approx(top1_w10, abs=0.005)
