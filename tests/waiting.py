"""Wait for a condition in another thread or process."""

import time


def wait_until(condition, seconds=60.0):
    """Wait until a condition holds; fail after so many seconds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "the condition did not come true in time"
        time.sleep(0.02)
