"""`torchelev demo`: a walk over a simulated course, mapped and compared with the ground truth, or recorded as a bag."""

from torchelev.app.demo.run import run_demo
from torchelev.app.demo.walk import DT, DemoWalk

__all__ = ["DT", "DemoWalk", "run_demo"]
