"""Density clusters: which points are one cluster and which are several, at any scale."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bgpo_trl.modules.density_clusters import density_clusters, intrinsic_dimension

CENTERS = 9 * np.eye(6)


def blobs(sizes, d=6, seed=0):
    """Gaussian blobs of unit variance, nine times their deviation from the origin."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(len(sizes)), sizes)
    return CENTERS[labels][:, :d] + rng.normal(size=(len(labels), d)), labels


@settings(max_examples=30)
@given(
    sizes=st.lists(st.integers(14, 60), min_size=2, max_size=5),
    exponent=st.sampled_from([-1, -0.5, 0, 0.5, 1]),
    seed=st.integers(0, 99),
)
def test_separate_clusters_are_found_at_any_scale_and_place(sizes, exponent, seed):
    points, labels = blobs(sizes, seed=seed)
    found = density_clusters(10**exponent * points + seed)
    inside = found >= 0
    assert found.max() + 1 == len(sizes)
    assert inside.mean() > 0.9
    assert (found[inside] == labels[inside]).all()  # numbered by their first points


def shapes():
    rng = np.random.default_rng(4)
    turn = rng.uniform(0, 2, size=300)
    yield "ball", rng.normal(size=(400, 8))
    yield "cube", rng.uniform(size=(400, 3))
    yield "line", rng.normal(size=(400, 1))
    yield "heavy tails", rng.standard_t(4, size=(400, 5))
    yield "flat", rng.normal(size=(400, 10)) * 0.5 ** np.arange(10)
    yield "arc", np.stack([np.sin(turn), np.cos(turn)], 1) + 0.1 * rng.normal(size=(300, 2))
    yield "skewed", rng.gamma(1, size=(400, 4))
    yield "corners of a simplex", np.eye(40)
    yield "grid", np.argwhere(np.ones((15, 15))).astype(float)


@pytest.mark.parametrize(("name", "points"), [*shapes()], ids=lambda value: value)
def test_unimodal_points_are_one_cluster(name, points):
    assert not density_clusters(points).any()


def test_cluster_needs_the_least_number_of_points_and_the_evidence():
    points, _ = blobs([90, 14])
    assert density_clusters(points).max() == 1
    few = points[:-5]  # nine points of the second
    assert not density_clusters(few).any()
    assert density_clusters(few, smallest=6).max() == 1
    assert not density_clusters(points, evidence=50.0).any()


def test_far_points_are_outliers_only_beside_several_clusters():
    points, labels = blobs([40, 40])
    far = points.mean(0) + 30 * np.eye(6)[[4, 5]]
    assert density_clusters(np.vstack([points, far])).tolist() == [*labels, -1, -1]
    assert not density_clusters(np.vstack([points[:40], far])).any()


def test_clusters_do_not_depend_on_the_order_of_points():
    points, _ = blobs([30, 50, 20])
    order = np.random.default_rng(1).permutation(len(points))
    ours, theirs = density_clusters(points)[order], density_clusters(points[order])
    assert len({*zip(ours.tolist(), theirs.tolist(), strict=True)}) == ours.max() + 1 == 3


@pytest.mark.parametrize("d", [1, 2, 5])
def test_intrinsic_dimension_of_a_cube_is_that_of_its_space(d):
    points = np.zeros((1_500, 7))
    points[:, :d] = np.random.default_rng(0).uniform(size=(1_500, d))
    distances = np.sort(np.linalg.norm(points[:, None] - points, axis=-1))[:, 1:11]
    assert intrinsic_dimension(distances, 7) == pytest.approx(d, rel=0.15)
    assert intrinsic_dimension(np.ones((4, 10)), 7) == 7
