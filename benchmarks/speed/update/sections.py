"""The sections of `benchmarks.speed.run`: each takes the time for a row [s] and returns its part of the JSON."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.speed.update.scaling import cells, points, rays, robots, threads
from benchmarks.speed.update.stages import parts, stages
from benchmarks.speed.update.startup import start

SECTIONS: dict[str, Callable[[float], dict[str, Any]]] = {
    "points": points,
    "stages": stages,
    "threads": threads,
    "robots": robots,
    "cells": cells,
    "rays": rays,
    "parts": parts,
    "start": start,
}
