"""Work on several threads: order of the results, and loading of kernels by one thread."""

import threading
import time

import pytest

from neuma_lib.threads import in_threads

pytestmark = pytest.mark.core


@pytest.mark.parametrize("count", [1, 3])
def test_the_first_item_of_each_key_is_processed_alone(count):
    """Also of a key that appears later, and once: items of known keys share the threads."""
    first, second = object(), object()
    running, company, lock = set(), {}, threading.Lock()

    def work(item):
        with lock:
            running.add(item)
        time.sleep(0.05)
        with lock:
            company[item] = set(running) - {item}
            running.remove(item)
        return 10 * item

    kernels = [first, first, second, first, second]
    assert in_threads(work, range(5), kernels, count) == [0, 10, 20, 30, 40]
    assert not company[0] and not company[2]
    assert any(company.values()) == (count > 1)
    assert in_threads(work, range(2), [first, second], count) == [0, 10]
    assert any(company[item] for item in (0, 1)) == (count > 1)
    assert in_threads(work, [], [], count) == []
