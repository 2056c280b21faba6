"""The structures of `torchelev.h`, for ctypes."""

from __future__ import annotations

import ctypes

POINTER, COUNT = ctypes.c_void_p, ctypes.c_int64


#: fields of `torchelev_statistics`, by whether they are numbers of metres
STATISTICS = {
    **dict.fromkeys(
        (
            "points_used",
            *(f"rejected_{gate}" for gate in ("invalid", "range", "body", "overhang", "outside", "outlier", "edge")),
            "drift_points",
        ),
        False,
    ),
    **dict.fromkeys(("drift_error", "drift_correction", "disagreement"), True),
    **dict.fromkeys(("cleared_seen_through", "cleared_other_floors", "cells_bounded"), False),
}


class Limits(ctypes.Structure):
    """`torchelev_limits`."""

    _fields_ = (("max_points", COUNT), ("max_sensors", ctypes.c_int32), ("num_threads", ctypes.c_int32))


class Statistics(ctypes.Structure):
    """`torchelev_statistics`."""

    _fields_ = tuple((name, ctypes.c_double if metres else COUNT) for name, metres in STATISTICS.items())


class Input(ctypes.Structure):
    """`torchelev_input`."""

    _fields_ = (
        *(("num_sensors", ctypes.c_int32), ("num_points", COUNT)),
        *((name, POINTER) for name in ("points", "T_map_sensor", "T_map_base", "T_base_links")),
        ("dt", ctypes.c_double),
        *((name, POINTER) for name in ("variance", "pose_covariance")),
    )
