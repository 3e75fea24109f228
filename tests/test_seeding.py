"""Streams of random numbers: the same in any batch, and each different from all others."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bgpo_trl.seeding import generators, stream_seed

seeds = st.integers(0, 2**40)
names = st.sampled_from(
    ["env", "demonstrations", "gwr", "actor", "critic", "replay", "exploration", "evaluation"]
)


@given(seeds, names)
def test_a_stream_is_determined_by_seed_and_name_and_suits_every_generator(seed, name):
    number = stream_seed(seed, name)
    assert number == stream_seed(seed, name)
    np.random.RandomState(number)
    assert torch.Generator().manual_seed(number).initial_seed() == number


def test_streams_are_those_of_earlier_versions():
    """Changing them would change every run: results would not be reproduced any more."""
    assert [stream_seed(0, "env"), stream_seed(7, "exploration")] == [643454646, 2305761175]


def test_no_two_streams_are_the_same():
    numbers = {
        stream_seed(seed, name)
        for seed, name in itertools.product(range(200), ["env", "actor", "critic", "replay"])
    }
    assert len(numbers) == 800


@given(st.lists(seeds, min_size=1, max_size=4, unique=True), names)
def test_a_seed_has_the_same_generator_in_any_batch(batch, name):
    for seed, together in zip(batch, generators(batch, name), strict=True):
        (alone,) = generators([seed], name)
        assert torch.rand(3, generator=together).equal(torch.rand(3, generator=alone))


def test_generators_share_nothing():
    first, second = generators([1, 1], "env")
    torch.rand(10, generator=first)
    (fresh,) = generators([1], "env")
    assert torch.rand(3, generator=second).equal(torch.rand(3, generator=fresh))


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="non-negative"):
        stream_seed(-1, "env")
