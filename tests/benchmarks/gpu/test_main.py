"""The command of the GPU benchmark: verdicts on what was measured."""

from benchmarks.gpu.__main__ import verdicts


def test_gpu_verdicts_of_what_was_measured():
    result = {
        "correctness": {"run to run, deterministic": {"largest_difference_m": 0.0}},
        "host never waits, eager": {"holds": True},
        "host never waits, compiled": {"error": "called a synchronizing CUDA operation"},
        "one robot, captured": {"median": 0.2},
        "many robots, update": {"median": 8.0},
        "many robots, captured": {"median": 4.0},
        "many robots, expected bytes": 10**9,
        "copy, bytes per second": 10**12,
    }
    assert [row[-1] for row in verdicts(result)] == ["met", "missed", "met", "met", "met"]
    assert [row[-1] for row in verdicts({"correctness": {"error": "none"}})] == ["missed", "met"]
