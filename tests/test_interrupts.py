"""Ctrl-C, put off and then answered."""

import signal
import threading

import pytest

from edge_depth_nerf.base.interrupts import ctrl_c_put_off


def test_ctrl_c_is_answered_after_what_would_lose_it():
    done = []
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        with ctrl_c_put_off():
            signal.raise_signal(signal.SIGINT)
            done.append("the rest")
        done.append("never")
    assert done == ["the rest"]
    assert signal.getsignal(signal.SIGINT) is before


def test_without_ctrl_c_and_in_other_threads_nothing_happens():
    before, done = signal.getsignal(signal.SIGINT), []

    def work() -> None:
        with ctrl_c_put_off():
            done.append(signal.getsignal(signal.SIGINT))

    thread = threading.Thread(target=work)
    thread.start()
    thread.join()
    with ctrl_c_put_off():
        pass
    assert done == [before] and signal.getsignal(signal.SIGINT) is before
