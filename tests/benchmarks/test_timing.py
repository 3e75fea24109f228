"""Interleaved timing, against a clock that is told what to show."""

import pytest
from timing import Timing, interleave, ratio


def test_contenders_take_turns_and_only_rounds_after_the_warmup_count():
    now, calls = [0.0], []

    def contender(name, seconds):
        def call():
            calls.append(name)
            now[0] += seconds

        return call

    times = interleave(
        {"a": contender("a", 1.0), "b": contender("b", 3.0)},
        rounds=2,
        warmup=1,
        clock=lambda: now[0],
    )
    assert calls == ["a", "b"] * 3
    assert times == {"a": [1.0, 1.0], "b": [3.0, 3.0]}


def test_quartiles_by_hand():
    assert Timing.of([5.0, 1.0, 3.0, 2.0, 4.0]) == Timing(median=3.0, low=2.0, high=4.0)


def test_a_slow_spell_of_the_machine_leaves_the_ratio_as_it_is():
    a, b = [1.0, 10.0, 1.0], [2.0, 20.0, 2.0]
    assert ratio(b, a) == Timing(2.0, 2.0, 2.0)
    with pytest.raises(ValueError):
        ratio(a, b[:2])
