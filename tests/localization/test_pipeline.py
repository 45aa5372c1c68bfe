"""The pipeline: order, overlap, bounds, errors and threads."""

import threading
import time

import pytest

from wheretolook.localization.shard import Step, run_pipeline


@pytest.fixture(autouse=True)
def no_thread_is_left():
    before = threading.active_count()
    yield
    assert threading.active_count() == before


def slowly(seconds):
    def run(item):
        time.sleep(seconds)
        return item

    return Step(f"slow {seconds}", run)


def test_order_is_kept_whichever_item_takes_longest():
    def uneven(item):
        time.sleep(0.01 * (item % 3))
        return item

    steps = [Step("double", lambda item: 2 * item), Step("wait", uneven), Step("text", str)]
    assert list(run_pipeline(range(20), steps)) == [str(2 * i) for i in range(20)]
    assert list(run_pipeline([], steps)) == []


class OwnError(BaseException):
    """A BaseException that is not an Exception."""


@pytest.mark.parametrize("place", ["source", "first", "last"])
@pytest.mark.parametrize("error", [ValueError, OwnError])
def test_an_error_of_any_step_is_raised_after_the_items_before_it(place, error):
    def source():
        for item in range(1000):
            if place == "source" and item == 5:
                raise error("five")
            yield item

    def failing(name):
        def run(item):
            if place == name and item == 5:
                raise error("five")
            return item

        return Step(name, run)

    got = []
    with pytest.raises(error):
        for item in run_pipeline(source(), [failing("first"), slowly(0.001), failing("last")]):
            got.append(item)
    assert got == [0, 1, 2, 3, 4]


def test_a_consumer_that_leaves_ends_the_threads():
    before = threading.active_count()
    run = run_pipeline(iter(int, 1), [Step("a", abs), Step("b", abs)])
    next(run)
    assert threading.active_count() == before + 3
    start = time.perf_counter()
    run.close()
    assert threading.active_count() == before
    assert time.perf_counter() - start < 2

    with pytest.raises(KeyError):
        for _ in run_pipeline(range(1000), [slowly(0.01)]):
            raise KeyError("the consumer's own")
