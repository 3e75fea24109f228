"""Rows shared between threads."""

import pickle
import sys
import threading

import pytest

from bgpo_trl.machine import RowPool


@pytest.fixture(params=[1, 3, 20])
def threads(request):
    threads = RowPool(request.param, "test")
    yield threads
    threads.close()


def test_each_row_is_computed_once_and_received_by_the_calling_thread(threads):
    rows, places = list(range(3, 15)), set()

    def arrived(row, result):
        places.add(threading.current_thread())
        results.append((row, result))

    for _ in range(2):
        results: list[tuple[int, int]] = []
        threads.each(rows, lambda row: row**2, arrived)
        assert sorted(results) == [(row, row**2) for row in rows]
    threads.each([], lambda row: row, arrived)
    assert places == {threading.current_thread()}


def test_an_error_in_a_thread_is_raised_after_all_have_ended(threads):
    interval, working = sys.getswitchinterval(), []

    def work(row):
        working.append(row)
        try:
            if row == 7:
                raise ValueError("row 7")
        finally:
            working.remove(row)

    with pytest.raises(ValueError, match="row 7"):
        threads.each(range(12), work, lambda row, result: None)
    assert not working
    assert sys.getswitchinterval() == interval


def test_a_copy_has_its_own_threads(threads):
    copy, results = pickle.loads(pickle.dumps(threads)), {}
    threads.close()
    copy.each(range(5), lambda row: row**2, results.__setitem__)
    assert results == {row: row**2 for row in range(5)}
    copy.close()
