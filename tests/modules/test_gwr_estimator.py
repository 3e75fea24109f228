"""GWR-B as a scikit-learn estimator."""

import importlib
import sys

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.datasets import make_blobs
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

from bgpo_trl.configs import GWRBConfig
from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.gwr_estimator import GWRBEstimator

GAPS = "labels are identities of nodes, with gaps where one was removed or is nearest to no row"


@pytest.fixture
def rows():
    points, _ = make_blobs(200, centers=3, random_state=0)
    return StandardScaler().fit_transform(points)


@pytest.mark.parametrize(
    ("model", "expected_failed_checks"),
    [
        (GWRBEstimator(), {}),
        (
            GWRBEstimator(GWRBConfig(max_age=3, habituation_threshold=1.0)),
            {"check_clustering": GAPS},
        ),
    ],
    ids=["table 1", "growing"],
)
@pytest.mark.filterwarnings("ignore")  # of which scikit-learn's checks raise some on purpose
def test_scikit_learns_own_checks_pass(model, expected_failed_checks, monkeypatch):
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")  # without it one of the checks is left out
    results = check_estimator(
        model, expected_failed_checks=expected_failed_checks, on_skip=None, on_fail=None
    )
    others = {r["check_name"]: r["status"] for r in results if r["status"] != "passed"}
    assert others == dict.fromkeys(expected_failed_checks, "xfail")
    assert len(results) > 40


def test_estimator_equals_the_network_that_adapts_to_the_rows(rows):
    config = GWRBConfig(activity_scale=3.0, habituation_threshold=0.5, max_age=20)
    model, gwr = GWRBEstimator(config), GWRB(2, config, init="data").double()
    for piece in np.split(rows, [1, 50]):
        model.partial_fit(piece)
    for row in rows:
        gwr.adapt(row)
    match = gwr.lookup(rows)
    assert model.gwr_.num_nodes == gwr.num_nodes > 8
    assert model.predict(rows).tolist() == match.node.tolist()
    assert model.transform(rows).tolist() == match.embedding.tolist()
    assert model.labels_.tolist() == match.node[50:].tolist()
    whole = clone(model).fit(rows)
    assert whole.labels_.tolist() == match.node.tolist()
    assert whole.fit(rows[:2]).gwr_.num_nodes == 2  # a new network


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_rows_that_are_not_finite_are_rejected_before_any_is_learned(rows, bad):
    model = GWRBEstimator().fit(rows)
    before = model.gwr_.get_extra_state()
    spoilt = rows.copy()
    spoilt[-1, 0] = bad
    for call in (model.partial_fit, model.fit, model.predict):
        with pytest.raises(ValueError, match=r"NaN|infinity"):
            call(spoilt)
    torch.testing.assert_close(model.gwr_.get_extra_state(), before, rtol=0, atol=0)


def test_import_without_scikit_learn_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.base", None)
    monkeypatch.delitem(sys.modules, GWRBEstimator.__module__)
    with pytest.raises(ImportError, match=r"pip install 'bgpo_trl\[sklearn\]'"):
        importlib.import_module(GWRBEstimator.__module__)
