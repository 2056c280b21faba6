"""Choose how MuJoCo draws on a machine without a screen; imported before MuJoCo, which reads this once."""

import ctypes.util
import os
import sys

if sys.platform == "linux" and "DISPLAY" not in os.environ and ctypes.util.find_library("EGL"):
    os.environ.setdefault("MUJOCO_GL", "egl")
