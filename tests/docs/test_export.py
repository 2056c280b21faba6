"""The page on torch.export: a program that loads without torchelev, and does what an update does to the bit."""

import pytest
import torch

from tests.docs.markdown import DOCS, code_blocks, run_blocks
from tests.processes import run_python

LOAD = """
import sys, torch
step = torch.export.load({path!r}).module()
inputs = torch.load({inputs!r})
with torch.no_grad():
    values = [step(*given)[0] for given in inputs]
torch.save(values, {out!r})
print("torchelev" in sys.modules)
"""


@pytest.fixture(scope="module")
def page():
    path = DOCS / "howto" / "export.md"
    return run_blocks(path, [block for block in code_blocks(path.read_text()) if block.language == "python"])


@pytest.mark.slow(30)
def test_the_program_runs_without_torchelev_to_the_bit(page, tmp_path):
    torch.manual_seed(1)
    inputs = [page["measure"](N) for N in (700, 40, 1200)]
    for k, dt in enumerate((0.02, 0.5, 0.1)):
        inputs[k][3].fill_(dt)
    inputs[2][4][1] = True  # robot 1 begins anew
    torch.save(inputs, tmp_path / "inputs.pt")
    files = {"path": str(page["path"]), "inputs": str(tmp_path / "inputs.pt"), "out": str(tmp_path / "out.pt")}
    done = run_python(LOAD.format(**files))
    assert done.stdout.strip() == "False", done.stderr
    reference = page["Step"]()
    with torch.no_grad():
        expected = [reference(*given)[0] for given in inputs]
    found = torch.load(tmp_path / "out.pt")
    assert all(torch.equal(a, b) for a, b in zip(found, expected, strict=True))
    assert not torch.equal(expected[0], expected[1])
