"""Growth of time, memory and compiled graphs over a long run."""

from benchmarks.speed.common import growth


def test_growth_is_found_in_time_memory_and_graphs():
    steady = {"updates": 400, "ms": [9.0, 3.0, 3.1, 3.0] * 3, "resident_bytes": [10**8] * 12, "graphs": [1] * 12}
    steady |= {"reference_ms": [9.1, 3.0, 3.0, 3.1] * 3, "old_ms": [3.0, 6.0, 3.1], "new_ms": [3.0, 6.1, 3.0]}
    worse_machine = steady | {name: [3.0 + 0.1 * k for k in range(12)] for name in ("ms", "reference_ms")}
    slower = steady | {"ms": [ms * (1 + 0.008 * k) for k, ms in enumerate(steady["ms"])]}
    older = steady | {"new_ms": [2.8, 5.6, 2.7]}
    larger = steady | {"resident_bytes": [10**8 + 10**6 * k for k in range(12)]}
    again = steady | {"graphs": [1] * 6 + [2] * 6}
    cases = [steady, worse_machine, slower, older, larger, again]
    rows = growth.verdicts({str(number): values for number, values in enumerate(cases)})
    assert [row[-1] for row in rows] == ["none grows"] * 2 + ["GROWS"] * 4
