"""Named streams of random numbers: reproducible, distinct, and the same in any batch."""

import itertools

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from bgpo_trl.seeding import generators, row_seeds, stream_seed

seeds = st.integers(0, 2**40)
names = st.sampled_from(
    ["env", "demonstrations", "gwr", "actor", "critic", "replay", "exploration", "evaluation"]
)


@given(seeds, names)
def test_seed_and_name_determine_a_stream_for_any_generator(seed, name):
    number = stream_seed(seed, name)
    assert number == stream_seed(seed, name)
    np.random.RandomState(number)
    assert torch.Generator().manual_seed(number).initial_seed() == number


def test_streams_are_those_of_earlier_versions():
    """Other numbers would change every run, so that no result could be reproduced."""
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


def test_rows_have_the_seeds_given_count_up_from_one_or_have_fresh_ones():
    for seed in (2**32 - 2, np.int64(2**32 - 2)):
        assert row_seeds(seed, 4) == [2**32 - 2, 2**32 - 1, 0, 1]
    for seeds in ((8, 3), np.array([8, 3]), torch.tensor([8, 3])):
        assert row_seeds(seeds, 2) == [8, 3]
    assert len({*row_seeds(None, 4), *row_seeds(None, 4)}) == 8
    with pytest.raises(ValueError, match="2 seeds for 3 simulations"):
        row_seeds([8, 3], 3)
    for wrong in (-1, 2**32, [0, -1], [2**32, 0]):
        with pytest.raises(ValueError, match="a seed must lie in"):
            row_seeds(wrong, 2)
