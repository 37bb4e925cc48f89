"""Work spread over threads: results in order, few begun ahead, errors where they are due."""

import threading

import pytest

from nurec_sim.compute import cores
from nurec_sim.compute.cores import in_order


def test_results_come_in_the_order_of_the_items_whichever_ends_first(monkeypatch):
    monkeypatch.setattr(cores, "usable_cores", lambda: 2)
    second_done = threading.Event()

    def work(item):
        if item == 0:
            assert second_done.wait(10)
        second_done.set()
        return item * item

    assert list(in_order(work, range(5))) == [0, 1, 4, 9, 16]


def test_only_a_few_items_are_begun_before_their_results_are_taken(monkeypatch):
    monkeypatch.setattr(cores, "usable_cores", lambda: 2)
    taken = []
    results = in_order(lambda item: item, (taken.append(i) or i for i in range(1000)))
    assert [next(results) for _ in range(3)] == [0, 1, 2]
    results.close()
    assert len(taken) <= 3 + 2 * 2


def test_items_that_are_begun_beside_a_long_one_do_not_wait_for_its_result(monkeypatch):
    monkeypatch.setattr(cores, "usable_cores", lambda: 2)
    last_done = threading.Event()

    def work(item):
        if item == 0:
            assert last_done.wait(10)
        if item == 19:
            last_done.set()
        return item

    assert list(in_order(work, range(20), ahead=20)) == list(range(20))


def test_an_error_comes_where_its_result_is_due():
    results = in_order(lambda item: 1 / item, [1, 0, 2])
    assert next(results) == 1
    with pytest.raises(ZeroDivisionError):
        next(results)
