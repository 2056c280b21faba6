"""The tables of the GPU benchmark: times, and verdicts on what was measured."""

from benchmarks.gpu.report import table, verdicts


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
    assert [row[-1] for row in verdicts({"correctness": {"error": "none"}})] == ["missed"]
    assert verdicts({}) == []  # what was not measured is not judged


def test_gpu_table_names_what_was_not_measured():
    time = {"median": 0.44, "min": 0.4283}
    result = {
        "machine": {"device": "A GPU"},
        "one robot, captured": time,
        "many robots, update": time,
        "many robots": {"robots": 4096},
        "height scans": time,
        "reset": {"error": "none"},
    }
    rows = [line.split("|")[2:-1] for line in table(result).splitlines()[2:]]
    shown = [[cell.strip() for cell in row] for row in rows]
    some = "0.44 (0.428)"
    assert shown == [["–", "–", some], ["–", some, "–"], [some, "–", "–"]]
