"""Jobs beside the caller: results in their order, few at a time, errors where they can be seen."""

import threading
from functools import partial

import pytest

from spnr_jax.devices.side_by_side import beside, two_at_a_time


def test_results_come_in_their_order_from_another_thread():
    caller = threading.get_ident()
    found = list(beside(partial(lambda i: (i, threading.get_ident()), i) for i in range(20)))
    assert [i for i, _ in found] == list(range(20))
    assert caller not in {thread for _, thread in found}


def test_jobs_are_made_while_others_run_but_few_ahead_of_them():
    made, free = [], threading.Event()

    def jobs():
        for i in range(10):
            made.append(i)
            if i == 3:
                free.set()  # nothing is done before: the fourth is made while the first runs
            yield partial(free.wait, 10)

    results = beside(jobs(), most=3)
    assert next(results) is True
    assert made == [0, 1, 2, 3]
    results.close()


def test_an_error_of_a_job_or_of_their_maker_is_raised():
    def broken():
        yield int
        raise ValueError("this one")

    with pytest.raises(ValueError, match="this one"):
        list(beside(broken()))
    with pytest.raises(ValueError, match="invalid literal"):
        list(beside(iter([int, partial(int, "word"), int])))


class TestTwoAtATime:
    def test_results_come_in_their_order_the_first_is_alone_and_two_meet_at_most(self):
        both, running, most = threading.Barrier(2, timeout=10), [], []

        def work(i):
            running.append(i)
            most.append((i, len(running)))
            if i in (1, 2):
                both.wait()
            running.remove(i)
            return i

        assert list(two_at_a_time(work, range(6))) == list(range(6))
        assert most[0] == (0, 1)
        assert max(count for _, count in most) == 2

    def test_few_are_begun_ahead_of_the_caller(self):
        begun = []
        results = two_at_a_time(begun.append, range(9))
        next(results)
        next(results)
        results.close()
        assert len(begun) <= 4

    def test_an_error_is_raised_in_its_place_and_nothing_is_done_for_no_items(self):
        assert list(two_at_a_time(int, [])) == []
        results = two_at_a_time(lambda i: 1 // i, [1, 0, 1])
        assert next(results) == 1
        with pytest.raises(ZeroDivisionError):
            next(results)
