"""Work in several threads, each part of which is done once, and which ends if a part fails."""

import os
import threading
import time

import pytest

from framework.storage.threads import SPINS, Pool, limit_spinning


@pytest.mark.parametrize(
    ("set_by_user", "spins"),
    [({}, SPINS), ({"OMP_WAIT_POLICY": "ACTIVE"}, None), ({"GOMP_SPINCOUNT": "2000"}, "2000")],
)
def test_openmp_threads_soon_sleep_unless_the_user_says_otherwise(
    set_by_user: dict[str, str], spins: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("OMP_WAIT_POLICY", "GOMP_SPINCOUNT"):
        monkeypatch.setenv(name, "")  # so that it is put back afterwards
        monkeypatch.delenv(name)
    for name, value in set_by_user.items():
        monkeypatch.setenv(name, value)
    limit_spinning()
    assert os.environ.get("GOMP_SPINCOUNT") == spins
    assert os.environ.get("OMP_WAIT_POLICY") == set_by_user.get("OMP_WAIT_POLICY")


@pytest.mark.parametrize("threads", [1, 2, 5])
@pytest.mark.parametrize("count", [0, 1, 40])
def test_each_number_is_worked_on_once_by_as_many_threads_as_may(threads: int, count: int) -> None:
    pool, done, helping = Pool(), [], set()

    def work(number: int) -> None:
        helping.add(threading.get_ident())
        time.sleep(1e-4)
        done.append(number)

    for _ in range(2):  # the threads stay
        pool.share(work, count, threads)
        assert sorted(done) == list(range(count))
        assert len(helping) <= min(threads, max(count, 1))
        done.clear()


@pytest.mark.parametrize("threads", [1, 3])
def test_where_one_fails_its_error_comes_and_the_others_stop(threads: int) -> None:
    pool, done = Pool(), []

    def work(number: int) -> None:
        if number == 7:
            raise ValueError("the eighth")
        time.sleep(1e-3)
        done.append(number)

    with pytest.raises(ValueError, match="the eighth"):
        pool.share(work, 1000, threads)
    time.sleep(0.02)
    assert len(done) < 500
    pool.share(done.append, 3, threads)  # and is of use again
    assert sorted(done[-3:]) == [0, 1, 2]
