"""Jobs beside the caller: results in their order, few at a time, errors where they can be seen."""

import threading
from functools import partial

import pytest

from spnr_jax.devices.side_by_side import beside


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
