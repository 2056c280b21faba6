"""A process that runs one peer: `python -m benchmarks.peers.worker NAME`, spoken to by pickles on stdin and stdout.

It imports NumPy and the peer, so that it also runs in a Python without torchelev, given the folder of `benchmarks`.
"""

import importlib
import os
import pickle
import sys
import time

from benchmarks.peers.peer import Peer


def resident(process="self"):
    """Return the memory [bytes] of a process, by its number; of this one without it."""
    with open(f"/proc/{process}/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def main():
    """Answer until stdin ends: (setup), then frames, each with its times, and None for the ground."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what a package prints is no answer
    module = importlib.import_module("benchmarks.peers.maps." + sys.argv[1])
    peer: Peer | None = None
    answer: object
    least = 0
    while True:
        try:
            given = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        if peer is None:
            least, peer, answer = resident(), module.Map(given), None
        elif given is None:
            answer = (*peer.ground(), resident() - least)
        else:
            start, cpu = time.perf_counter(), time.process_time()
            peer.update(given)
            answer = time.perf_counter() - start, time.process_time() - cpu
        pickle.dump(answer, answers, protocol=4)
        answers.flush()


if __name__ == "__main__":
    main()
