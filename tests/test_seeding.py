"""Named streams of random numbers: reproducible and distinct."""

import numpy as np
import pytest
import torch

from bgpo_trl.seeding import row_seeds, stream_seed


def test_streams_are_those_of_earlier_versions():
    """Other numbers would change every run, so that no result could be reproduced."""
    assert [stream_seed(0, "env"), stream_seed(7, "exploration")] == [643454646, 2305761175]


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
    for wrong in (1.5, [1.5, 2.0]):
        with pytest.raises(TypeError):
            row_seeds(wrong, 2)
