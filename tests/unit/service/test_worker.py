"""One job after another, whatever becomes of each."""

from __future__ import annotations

import logging
import threading

import pytest

from controller.service.worker import Worker


def test_a_job_that_fails_is_told_and_the_next_is_done(caplog: pytest.LogCaptureFixture) -> None:
    worker = Worker("reload", waiting=1)
    done = threading.Event()

    def fail() -> None:
        raise OSError("no such file")

    with caplog.at_level(logging.ERROR):
        assert worker.offer(fail, lambda: None)
        assert worker.offer(lambda: None, done.set)
        assert done.wait(20.0)
    worker.close(20.0)
    assert "reload: a job failed" in caplog.text
    assert "no such file" in caplog.text
