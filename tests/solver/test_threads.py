"""Threads: their number, limits, and results that do not depend on them."""

from __future__ import annotations

import os
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from pliant.solver import KnownCamera, Settings, Solution, gallery, solve, threads_limited
from pliant.solver.operators import normal_equations
from pliant.solver.threads import available_cores, over_ranges, serial_blas
from threadpoolctl import threadpool_info, threadpool_limits


@pytest.fixture
def many_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(4)), raising=False)


def threads_at_once(count: int) -> int:
    """How many threads `over_ranges` runs at the same time."""
    seen: set[int] = set()
    meet = threading.Barrier(min(count, available_cores()))

    def work(start: int, stop: int) -> None:
        meet.wait(timeout=10)  # raises if fewer threads arrive
        seen.add(threading.get_ident())

    over_ranges(work, count)
    return len(seen)


def test_work_uses_the_cores_available_to_the_process(many_cores: None) -> None:
    assert available_cores() == 4
    assert threads_at_once(100) == 4
    assert threads_at_once(3) == 3


@pytest.mark.parametrize(("limit", "threads"), [(1, 1), (3, 3), (50, 4), (None, 4)])
def test_a_thread_limit_holds_only_inside_its_block(many_cores: None, limit: int | None, threads: int) -> None:
    with threads_limited(limit):
        assert available_cores() == threads
        assert threads_at_once(100) == threads
        with threads_limited(2):
            assert available_cores() == 2
        assert available_cores() == threads
    assert available_cores() == 4


def test_a_thread_limit_does_not_affect_other_threads(many_cores: None) -> None:
    elsewhere: list[int] = []
    with threads_limited(1):
        other = threading.Thread(target=lambda: elsewhere.append(available_cores()))
        other.start()
        other.join()
    assert elsewhere == [4]


def test_a_limit_below_one_thread_is_rejected() -> None:
    with pytest.raises(ValueError, match="at least 1 thread, got 0"), threads_limited(0):
        pass


def test_a_limit_that_is_not_whole_is_rejected() -> None:
    with pytest.raises(TypeError), threads_limited(1.5):  # type: ignore[arg-type]
        pass


@pytest.mark.slow
def test_the_result_does_not_depend_on_the_number_of_threads(many_cores: None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        normal_equations, "SMALLEST", 1, raising=False
    )  # otherwise one thread would handle so small a sequence
    made = gallery.corrupt(gallery.face(8, 120), outliers=0.1, seed=2)
    cameras = KnownCamera.from_arrays(made.rotations, made.scales)

    def solved(threads: int) -> Solution:
        with threads_limited(threads):
            return solve(made.tracks, made.mesh, cameras=cameras, settings=Settings(max_reweightings=3))

    one, four = solved(1), solved(4)
    np.testing.assert_array_equal(one.trace.iterations, four.trace.iterations)
    np.testing.assert_array_equal(one.shapes, four.shapes)


def blas_threads() -> set[int]:
    return {library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"}


def test_blas_has_one_thread_during_a_solve_and_its_own_number_afterwards() -> None:
    seen: set[int] = set()
    case = gallery.face(5, 20)
    with threadpool_limits(limits=2, user_api="blas"):
        solve(case.tracks, settings=Settings(max_reweightings=1), on_step=lambda _: seen.update(blas_threads()))
        assert seen == {1}
        assert blas_threads() == {2}


def test_blas_stays_in_one_thread_until_the_last_of_several_solves_ends() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        one, other = serial_blas(), serial_blas()
        one.__enter__()
        other.__enter__()
        one.__exit__(None, None, None)
        assert blas_threads() == {1}
        other.__exit__(None, None, None)
        assert blas_threads() == {2}


def test_blas_has_one_thread_whichever_thread_of_the_program_solves_and_whichever_solved_before() -> None:
    seen: list[set[int]] = []

    def nested() -> None:
        with serial_blas():
            seen.append(blas_threads())
        seen.append(blas_threads())

    with threadpool_limits(limits=2, user_api="blas"):
        nested()
        with ThreadPoolExecutor(1) as pool:
            pool.submit(nested).result()
            nested()
    assert seen == [{1}, {2}] * 3


def test_blas_gets_its_threads_back_from_another_thread_than_that_which_limited_it() -> None:
    with threadpool_limits(limits=2, user_api="blas"), ThreadPoolExecutor(1) as pool:
        one, other = serial_blas(), serial_blas()
        pool.submit(one.__enter__).result()
        other.__enter__()
        pool.submit(one.__exit__, None, None, None).result()
        assert blas_threads() == {1}
        other.__exit__(None, None, None)
        assert blas_threads() == {2}


def test_a_failed_solve_leaves_the_threads_of_blas_as_they_were() -> None:
    with threadpool_limits(limits=2, user_api="blas"):
        with pytest.raises(ZeroDivisionError), serial_blas():
            raise ZeroDivisionError
        assert blas_threads() == {2}
