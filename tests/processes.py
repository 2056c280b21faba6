"""Run python code in a process of its own."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def run_python(code, path=None):
    """Run code in a new process in the checkout; `path` is a further folder that its imports are found in."""
    folders = [str(ROOT), *([str(path)] if path else []), os.environ.get("PYTHONPATH", "")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, folders))}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, env=env)


_FORKS = """
import importlib, json, os, runpy, sys, traceback
for name in sys.argv[1:]:
    importlib.import_module(name)
for line in sys.stdin:
    folder, script, *arguments = json.loads(line)
    if child := os.fork():
        print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), flush=True)
        continue
    os.chdir(folder)
    for number, name in ((1, "stdout"), (2, "stderr")):
        os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), number)
    sys.argv, code = [script, *arguments], 1
    sys.path.insert(0, os.path.dirname(script))
    try:
        runpy.run_path(script, run_name="__main__")
        code = 0
    except SystemExit as end:
        code = int(bool(end.code))
    except BaseException:
        traceback.print_exc()
    sys.stdout.flush(), sys.stderr.flush()
    os._exit(code)
"""


class Forks:
    """Runs scripts in forks of one process that has imported modules, which takes longer than many scripts do."""

    def __init__(self, *modules):
        env = {**os.environ, "PYTHONPATH": str(ROOT)}
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
        self._process = subprocess.Popen([sys.executable, "-c", _FORKS, *modules], env=env, **pipes)

    def run(self, folder, script, *arguments):
        """Run a script in a folder -> exit code, stdout and stderr, which are kept there as files."""
        self._process.stdin.write(json.dumps([str(folder), str(script), *arguments]) + "\n")
        self._process.stdin.flush()
        code = int(self._process.stdout.readline())
        return code, *((folder / name).read_text() for name in ("stdout", "stderr"))

    def close(self):
        self._process.stdin.close()
        self._process.wait()
        self._process.stdout.close()
