"""A Ctrl-C waits for the end of the block."""

import os
import signal

import pytest

from torchelev.app.interrupts import defer_interrupts


def test_ctrl_c_waits_for_the_end_of_the_block():
    done, before = [], signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    try:
        with pytest.raises(KeyboardInterrupt), defer_interrupts():
            os.kill(os.getpid(), signal.SIGINT)
            done.append("all of it")
        assert done and signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
