"""Probes whose perceptron learns for as long as a test has time."""

from functools import partial

import pytest

from bgpo_trl.encoders import probes


@pytest.fixture(scope="module", autouse=True)
def short_probes():
    with pytest.MonkeyPatch.context() as patch:
        short = partial(probes.perceptron_predict, steps=50)
        patch.setattr(probes, "perceptron_predict", short)
        yield
