"""The stages as slow NumPy loops over points and cells, written from the paper's equations: a file for each stage.

Nothing here comes from torchelev: plain numbers, lists, dicts and float64 arrays of one environment. A map is a dict of
(H, W) arrays; `corner` holds the cell numbers of cell [0, 0] on the map frame's lattice. Points are absolute.
"""

from tests.reference.body import first_hit, least, outside_box, outside_capsule, outside_robot, rotation_of, shapes_of
from tests.reference.drift import age, drift, height_error
from tests.reference.fusion import (
    agrees,
    challenge,
    consensus,
    extreme,
    fuse_cell,
    kalman,
    passed_center,
    scan_height,
    side_of_step,
    weighted_mean,
)
from tests.reference.measure import above_ramp, depth_to_points, inside_box, measure, voxel_means
from tests.reference.overlap import clear_other_floors, ground_below
from tests.reference.places import cell_of, center_of, recenter, window_corner
from tests.reference.poses import absolute_variance, deskew, pose_at, pose_variance, quaternion_of
from tests.reference.reading import feet_plane, nearest_foot, sample
from tests.reference.site import average_site_cell, fuse_site_cell, information, replaces, surest
from tests.reference.surface import fit_plane, spans_plane, step_at, traversability, window
from tests.reference.visibility import (
    believed_slope,
    clear_seen_through,
    march,
    over_centers,
    stays_above_recent,
    well_supported,
)

__all__ = [
    "above_ramp",
    "absolute_variance",
    "age",
    "agrees",
    "average_site_cell",
    "believed_slope",
    "cell_of",
    "center_of",
    "challenge",
    "clear_other_floors",
    "clear_seen_through",
    "consensus",
    "depth_to_points",
    "deskew",
    "drift",
    "extreme",
    "feet_plane",
    "first_hit",
    "fit_plane",
    "fuse_cell",
    "fuse_site_cell",
    "ground_below",
    "height_error",
    "information",
    "inside_box",
    "kalman",
    "least",
    "march",
    "measure",
    "nearest_foot",
    "outside_box",
    "outside_capsule",
    "outside_robot",
    "over_centers",
    "passed_center",
    "pose_at",
    "pose_variance",
    "quaternion_of",
    "recenter",
    "replaces",
    "rotation_of",
    "sample",
    "scan_height",
    "shapes_of",
    "side_of_step",
    "spans_plane",
    "stays_above_recent",
    "step_at",
    "surest",
    "traversability",
    "voxel_means",
    "weighted_mean",
    "well_supported",
    "window",
    "window_corner",
]
