"""Ctrl-C is heard between steps."""

from __future__ import annotations

import signal
import threading

import pytest

from leco_plugin.studio.trainer import HEARD, catch_first_interrupt


def test_the_second_ctrl_c_interrupts(capfd: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(KeyboardInterrupt), catch_first_interrupt() as asked:
        assert not asked.is_set()
        signal.raise_signal(signal.SIGINT)
        assert asked.is_set()
        assert capfd.readouterr().err == HEARD
        signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_whoever_listens_already_goes_on_listening() -> None:
    heard: list[str] = []
    before = signal.signal(signal.SIGINT, lambda *_: heard.append("theirs"))
    try:
        with catch_first_interrupt() as asked:
            signal.raise_signal(signal.SIGINT)
        assert heard == ["theirs"] and not asked.is_set()
    finally:
        signal.signal(signal.SIGINT, before)


def test_a_thread_that_hears_no_signals_runs_all_the_same() -> None:
    seen = []

    def work() -> None:
        with catch_first_interrupt() as asked:
            seen.append(asked.is_set())

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    assert seen == [False]
