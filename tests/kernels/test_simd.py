"""Vectors of C++: what must not depend on how long they are."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path

import pytest

from torchelev.kernels.cpu_build import find_compiler, instruction_set
from torchelev.kernels.registry import PACKAGE

_PROGRAM = """
#include <cstdio>
#include "kernels/simd.h"

int main() {
    PartialSums sum;
    float values[1000];
    for (int k = 0; k < 1000; k++) values[k] = 1.0f / float(k + 1);
    for_vectors(0, 1000, [&](int64_t k, auto count) { sum.add(k, load(values + k, count)); });
    std::printf("%d %a\\n", LANES, double(sum.total<float>()));
}
"""


@pytest.mark.skipif(platform.machine() != "x86_64", reason="vectors of AVX and of SSE")
def test_sums_do_not_depend_on_the_length_of_vectors(tmp_path: Path) -> None:
    compiler = find_compiler()
    if compiler is None or instruction_set() is None:
        pytest.skip("no compiler, or no AVX2")
    source = tmp_path / "sum.cpp"
    source.write_text(_PROGRAM)
    found = []
    for target in ("x86-64-v2", "x86-64-v3"):
        program = tmp_path / target
        command = [*compiler, "-std=c++17", "-O2", f"-march={target}", f"-I{PACKAGE}", source, "-o", program]
        subprocess.run(command, check=True)
        found.append(subprocess.run([program], check=True, capture_output=True, text=True).stdout.split())
    assert [int(lanes) for lanes, _ in found] == [4, 8]
    assert found[0][1] == found[1][1]
