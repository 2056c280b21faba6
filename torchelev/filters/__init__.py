"""Filters: functions from layers to a layer, batched over maps and registered by name.

A layer is a pair (values, known) of (B, H, W) tensors; `as_layer` makes one from values with NaN. Call a filter as a
function, as a module, or list it in a map's config:

```python
smooth = filters.gaussian(layer, resolution=0.04, sigma=0.1)
smooth = filters.Filter("gaussian", sigma=0.1)(layer, resolution=0.04)
cfg = ElevationMapConfig(filters=(FilterConfig(layer="smooth", filter="gaussian", settings={"sigma": 0.1}),))
```

The stages of the map update and its traversability are not filters; see `torchelev.stages` and
`torchelev.traversability`.
"""

from torchelev.filters.chain import FilterChain, FilterConfig
from torchelev.filters.distances.distance import signed_distance
from torchelev.filters.distances.distance_field import SignedDistanceField
from torchelev.filters.em_cupy import (
    em_cupy_erosion,
    em_cupy_inpainting,
    em_cupy_max_filter,
    em_cupy_min_filter,
    em_cupy_smooth_filter,
)
from torchelev.filters.expressions.expression import Expression, expression
from torchelev.filters.extrema import closing, dilation, erosion, maximum, minimum, opening
from torchelev.filters.geometry import (
    normal_x,
    normal_y,
    normal_z,
    roughness,
    slope,
    standard_deviation,
    step_height,
)
from torchelev.filters.inpainting.inpaint import (
    fill_from,
    inpaint_diffusion,
    inpaint_minimum,
    inpaint_navier_stokes,
    inpaint_nearest,
    inpaint_telea,
)
from torchelev.filters.layer_tools import as_layer, as_nan
from torchelev.filters.mean_curvature import curvature
from torchelev.filters.ratings import foothold_score, traversability_three_part
from torchelev.filters.registry import FILTERS, Filter, register
from torchelev.filters.smoothing import box, gaussian, median
from torchelev.filters.virtual_floor import smooth_ground, virtual_floor

__all__ = [
    "FILTERS",
    "Expression",
    "Filter",
    "FilterChain",
    "FilterConfig",
    "SignedDistanceField",
    "as_layer",
    "as_nan",
    "box",
    "closing",
    "curvature",
    "dilation",
    "em_cupy_erosion",
    "em_cupy_inpainting",
    "em_cupy_max_filter",
    "em_cupy_min_filter",
    "em_cupy_smooth_filter",
    "erosion",
    "expression",
    "fill_from",
    "foothold_score",
    "gaussian",
    "inpaint_diffusion",
    "inpaint_minimum",
    "inpaint_navier_stokes",
    "inpaint_nearest",
    "inpaint_telea",
    "maximum",
    "median",
    "minimum",
    "normal_x",
    "normal_y",
    "normal_z",
    "opening",
    "register",
    "roughness",
    "signed_distance",
    "slope",
    "smooth_ground",
    "standard_deviation",
    "step_height",
    "traversability_three_part",
    "virtual_floor",
]
