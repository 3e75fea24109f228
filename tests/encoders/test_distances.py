import math

import pytest
import torch

from bgpo_trl.encoders.distances import embedding_distances


def test_embedding_distances_by_hand() -> None:
    phi = torch.tensor([[0.0, 0.0], [0.1, 0.0], [0.0, 1.0], [0.0, 1.4]])
    result = embedding_distances(phi, torch.tensor([0, 0, 1, 1]), activity_threshold=0.8)
    assert result["phi_threshold_distance"] == pytest.approx(0.2231, abs=1e-4)
    # Nearest of the same task: .1 .1 .4 .4; of the other: 1, 1.005, 1, 1.4. Medians are lower.
    assert result["phi_nearest_same_task"] == pytest.approx(0.1)
    assert result["phi_nearest_other_task"] == pytest.approx(1.0)
    assert result["phi_distance_same_task"] == pytest.approx(0.1)
    assert result["phi_distance_other_task"] == pytest.approx(math.hypot(0.1, 1.0))
    assert result["phi_nearest_known"] == 0.5


def test_one_task_has_no_other() -> None:
    result = embedding_distances(torch.randn(3, 32), torch.zeros(3, dtype=torch.int64))
    assert math.isnan(result["phi_nearest_other_task"])
    assert result["phi_nearest_same_task"] > 0
