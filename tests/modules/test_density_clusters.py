"""Density clusters: which points are one cluster and which are several, at any scale."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.distance import pdist, squareform

from bgpo_trl.modules.density_clusters import (
    density_clusters,
    intrinsic_dimension,
    least_size,
    local_whitening,
)

CENTERS = 9 * np.eye(6)


def test_a_repeated_point_is_refused():
    """Its distance of 0 would make the dimension 0, and all clusters one."""
    points, _ = blobs([20, 40])
    for repeated in (np.concatenate([points, points[:1]]), 1e-165 * points):
        with pytest.raises(ValueError, match="two points are equal, or too near"):
            density_clusters(repeated)


def blobs(sizes, seed=0):
    """Gaussian blobs of unit variance, nine times their deviation from the origin."""
    rng = np.random.default_rng(seed)
    labels = np.repeat(np.arange(len(sizes)), sizes)
    return CENTERS[labels] + rng.normal(size=(len(labels), 6)), labels


@settings(max_examples=20)
@given(
    sizes=st.lists(st.integers(14, 60), min_size=2, max_size=5),
    exponent=st.sampled_from([-1, -0.5, 0, 0.5, 1]),
    seed=st.integers(0, 99),
)
def test_separate_clusters_are_found_at_any_scale_and_place(sizes, exponent, seed):
    points, labels = blobs(sizes, seed=seed)
    found = density_clusters(10**exponent * points + seed, evidence=1.5)  # more than chance has
    inside = found >= 0
    assert found.max() + 1 == len(sizes)
    assert inside.mean() > 0.9
    assert (found[inside] == labels[inside]).all()  # numbered by their first points


def shapes():
    rng = np.random.default_rng(4)
    turn = rng.uniform(0, 2, size=300)
    yield "line", rng.normal(size=(400, 1))
    yield "flat", rng.normal(size=(400, 10)) * 0.5 ** np.arange(10)
    yield "arc", np.stack([np.sin(turn), np.cos(turn)], 1) + 0.1 * rng.normal(size=(300, 2))
    yield "corners of a simplex", np.eye(40)
    yield "grid", np.argwhere(np.ones((15, 15))).astype(float)


@pytest.mark.parametrize(("name", "points"), [*shapes()], ids=lambda value: value)
def test_unimodal_points_are_one_cluster(name, points):
    assert not density_clusters(points).any()


@pytest.mark.parametrize("d", [2, 4, 8, 32])
@pytest.mark.parametrize("n_points", [40, 150, 600])
def test_chance_splits_no_points_with_a_single_mode(n_points, d):
    rng = np.random.default_rng(d)
    for points in (
        rng.normal(size=(n_points, d)),
        rng.uniform(size=(n_points, d)),
        rng.standard_t(4, size=(n_points, d)),
        rng.gamma(2, size=(n_points, d)),
    ):
        assert not density_clusters(points).any()
        assert not density_clusters(points @ local_whitening(points)).any()


def test_a_sparse_cluster_is_told_from_a_dense_one_beside_it():
    """The valley counts from both sides: it hardly lies below the sparse cluster."""
    told = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        labels = np.repeat([0, 1], [60, 30])
        points = rng.normal(size=(90, 3)) * np.array([1.0, 2.5])[labels, None]
        points[labels == 1, 0] += 9
        found = density_clusters(points)
        inside = found >= 0
        told += found.max() == 1 and (found[inside] == labels[inside]).mean() > 0.97
    assert told >= 26  # 29; from each side alone, 13


def test_cluster_needs_the_least_number_of_points_and_the_evidence():
    points, _ = blobs([600, 14])
    assert density_clusters(points).max() == 1
    few = points[:-5]  # nine points of the second, where ten are a cluster
    assert not density_clusters(few).any()
    assert density_clusters(few, smallest=6).max() == 1
    assert not density_clusters(points, evidence=50.0).any()


def test_fewer_points_make_a_cluster_among_few():
    assert [least_size(n, 10) for n in (1, 39, 40, 63, 64, 255, 256, 512, 10**6)] == [
        *(10, 10, 6, 6, 7, 8, 9, 10, 10)
    ]
    assert least_size(10**6, 5) == 5
    points, labels = blobs([9] * 5)
    np.testing.assert_array_equal(density_clusters(points), labels)
    assert density_clusters(points[:36]).max() < 1  # four clusters, each of less than ten


def test_far_points_are_outliers_only_beside_several_clusters():
    points, labels = blobs([40, 40])
    far = points.mean(0) + 30 * np.eye(6)[[4, 5]]
    assert density_clusters(np.vstack([points, far])).tolist() == [*labels, -1, -1]
    assert not density_clusters(np.vstack([points[:40], far])).any()


@pytest.mark.parametrize("d", [1, 2, 5])
def test_intrinsic_dimension_of_a_cube_is_that_of_its_space(d):
    points = np.zeros((1_000, 7))
    points[:, :d] = np.random.default_rng(0).uniform(size=(1_000, d))
    distances = np.sort(squareform(pdist(points)))[:, 1:11]
    assert intrinsic_dimension(distances, 7) == pytest.approx(d, rel=0.15)
    assert intrinsic_dimension(np.ones((4, 10)), 7) == 7


def test_local_whitening_is_the_inverse_root_of_the_covariance_of_neighbors_differences():
    """Worked by hand: pairs that are (2, 0) or (0, 1) apart, each other's nearest neighbors."""
    points = np.array([[0, 0], [2, 0], [100, 0], [100, 1.0]])
    # Mean outer product diag(2, 0.5): trace 2.5, sum of squares 4.25. With n = 4 and d = 2, the
    # shrinkage is (0 * 4.25 + 6.25) / (4 * (4.25 - 3.125)) > 1: a scaling with the mean of 1.25.
    whitening = local_whitening(points, k=1)
    np.testing.assert_allclose(whitening @ whitening.T, np.eye(2) / 1.25, atol=1e-12)
    # Ten such pairs of each kind: shrinkage 6.25 / (40 * 1.125).
    many = np.concatenate([points + 1_000 * np.array([i, i]) for i in range(10)])
    shrinkage = 6.25 / (40 * 1.125)
    variances = (1 - shrinkage) * np.array([2, 0.5]) + shrinkage * 1.25
    whitening = local_whitening(many, k=1)
    np.testing.assert_allclose(whitening @ whitening.T, np.diag(1 / variances), atol=1e-12)


def test_whitened_distances_do_not_depend_on_scale_rotation_and_place():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(200, 4)) * [1, 0.3, 0.1, 0.03]
    turn = np.linalg.qr(rng.normal(size=(4, 4)))[0]
    other = 50 * points @ turn + 7
    ours, theirs = points @ local_whitening(points), other @ local_whitening(other)
    np.testing.assert_allclose(pdist(ours), pdist(theirs), rtol=1e-8)


@pytest.mark.parametrize("constant", [0, 3])
def test_features_that_never_vary_do_no_harm(constant):
    points, labels = blobs([40, 40])
    points = np.concatenate([points, np.full((80, constant), 5.0)], 1)
    assert density_clusters(points @ local_whitening(points)).tolist() == labels.tolist()
