"""An observation term for mjlab: the height scan of a map that a RayCastSensor builds.

    python examples/mjlab_term.py --picture map.png

Where mjlab is not installed, it runs against the stand-ins of `stand_ins.py`. Copy `MapScan` and `MAP_SCAN` into your
task, and use them in place of the term `height_scan`. The sensor "rays" looks ahead and down from the robot, with a
`PinholeCameraPatternCfg`; `docs/howto/mjlab.md` shows its config.
"""

import argparse

import torch

from torchelev import ElevationMapConfig, GridConfig, HeightScan
from torchelev.integrations.mjlab import MapObservation
from torchelev.viz.plot import Panel, save_layers

try:
    from mjlab.managers import ObservationTermCfg
except ImportError:
    from stand_ins import ObservationTermCfg


class MapScan(MapObservation):
    """187 heights in the order and scale of mjlab's `height_scan`, read from each environment's own map."""

    read = HeightScan.mjlab(standing_height=0.5)  # your robot's base above flat ground [m]
    map_cfg = ElevationMapConfig(grid=GridConfig(resolution=0.05, length_x=4.0, length_y=4.0))
    with_validity = False  # True also gives the policy a mask of the known points


MAP_SCAN = ObservationTermCfg(func=MapScan, params={"sensor_name": "rays"})

if __name__ == "__main__":
    from stand_ins import Environment

    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--steps", type=int, default=40)
    parser.add_argument("--picture", help="file to write")
    args = parser.parse_args()

    env = Environment(num_envs=8)
    term = MAP_SCAN.func(MAP_SCAN, env)  # the observation manager does this, and calls the term in each step
    for _ in range(args.steps):
        env.step()
        observation = term(env, **MAP_SCAN.params)
    print(
        f"observation {tuple(observation.shape)}, from {float(observation.min()):.2f} to {float(observation.max()):.2f}"
    )
    if args.picture:
        layers = {name: term.emap.layer(name)[5].numpy() for name in ("elevation", "upper_bound", "traversability")}
        panels = [Panel(title=name, values=values) for name, values in layers.items()]
        save_layers(args.picture, panels, extent=(-2, 2, -2, 2), title="One of eight maps, robot in the middle")
    term.reset(env_ids=torch.tensor([0, 2]))
