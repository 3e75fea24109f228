"""GWR-B in scikit-learn's clothes: its own checks, and that it is the network of `test_gwr.py`."""

import importlib
import inspect
import sys

import numpy as np
import pytest
import torch
from sklearn.base import clone
from sklearn.datasets import make_blobs
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from sklearn.utils.estimator_checks import check_estimator

from bgpo_trl.modules.gwr import GWRB
from bgpo_trl.modules.gwr_estimator import GWRBEstimator

GAPS = "labels are identities of nodes, with gaps where one was removed or is nearest to no row"


@pytest.fixture
def rows():
    points, _ = make_blobs(200, centers=3, random_state=0)
    return StandardScaler().fit_transform(points)


@pytest.mark.parametrize(
    ("options", "expected_failed_checks"),
    [
        ({}, {}),
        ({"max_nodes": 3, "activity_scale": 2.0}, {}),
        ({"max_age": 3, "habituation_threshold": 1.0}, {"check_clustering": GAPS}),
    ],
    ids=["table 1", "capped", "growing"],
)
@pytest.mark.filterwarnings("ignore")  # of which scikit-learn's checks raise some on purpose
def test_scikit_learns_own_checks_pass(options, expected_failed_checks, monkeypatch):
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")  # without it one of the checks is left out
    results = check_estimator(
        GWRBEstimator(**options),
        expected_failed_checks=expected_failed_checks,
        on_skip=None,
        on_fail=None,
    )
    others = {r["check_name"]: r["status"] for r in results if r["status"] != "passed"}
    assert others == dict.fromkeys(expected_failed_checks, "xfail")
    assert len(results) > 40


def test_it_is_the_network_fed_with_the_rows(rows):
    options = {"activity_scale": 3.0, "habituation_threshold": 0.5, "max_age": 20}
    model, gwr = GWRBEstimator(**options), GWRB(2, init="data", **options).double()
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
    assert whole.fit(rows[:2]).gwr_.num_nodes == 2  # anew


def test_arguments_and_defaults_are_those_of_the_network():
    theirs = inspect.signature(GWRB).parameters
    params = GWRBEstimator().get_params()
    assert params == {name: theirs[name].default for name in params}
    assert theirs.keys() - params == {"n_features", "batch_size", "init", "generator"}
    with pytest.raises(ValueError, match="lr_best"):
        GWRBEstimator(lr_best=2.0).fit([[0.0], [1.0]])


def test_it_takes_part_in_a_pipeline(rows):
    pipeline = make_pipeline(StandardScaler(), GWRBEstimator(activity_scale=4.0))
    labels = pipeline.fit_predict(100 * rows + 7)
    assert pipeline.transform(100 * rows + 7).shape == rows.shape
    assert pipeline.get_feature_names_out(["x", "y"]).tolist() == ["x", "y"]
    assert labels.tolist() == GWRBEstimator(activity_scale=4.0).fit_predict(rows).tolist()


@pytest.mark.parametrize("bad", [np.nan, np.inf, 1e200])
def test_bad_rows_are_refused_before_any_is_learned(rows, bad):
    model = GWRBEstimator().fit(rows)
    before = model.gwr_.get_extra_state()
    spoilt = rows.copy()
    spoilt[-1, 0] = bad
    for call in (model.partial_fit, model.fit, model.predict):
        with pytest.raises(ValueError, match=r"NaN|infinity"):
            call(spoilt)
    torch.testing.assert_close(model.gwr_.get_extra_state(), before, rtol=0, atol=0)


def test_without_scikit_learn_one_is_told_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "sklearn.base", None)
    monkeypatch.delitem(sys.modules, GWRBEstimator.__module__)
    with pytest.raises(ImportError, match=r"pip install 'bgpo_trl\[sklearn\]'"):
        importlib.import_module(GWRBEstimator.__module__)
