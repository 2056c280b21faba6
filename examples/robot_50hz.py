"""A robot at 50 Hz: compiled updates, a thread that brings scans, one that shows the map, and latency percentiles.

    python examples/robot_50hz.py --picture latency.png

Only the loop touches the map, as no thread may read it while another updates it: the viewer's thread gets copies, five
times a second. Replace `sensor` by your driver.
"""

import argparse
import itertools
import queue
import threading
import time

import numpy as np

from torchelev import ElevationMap, ElevationMapConfig, GridConfig, HeightScan
from torchelev.io.publish import Publisher
from torchelev.sim import DepthCamera, walk
from torchelev.sim.exact.scenes import mixed

PERIOD = 0.02  # [s] of the loop
parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
parser.add_argument("--seconds", type=float, default=20.0)
parser.add_argument("--eager", action="store_true", help="do not compile")
parser.add_argument("--picture", help="file to write")
args = parser.parse_args()

# Scans of a simulated walk, made beforehand: simulating them takes longer than mapping them.
scene, camera = mixed(), DepthCamera(width=80, height=60)
path = walk(scene, [(-2.0, 0.0), (2.0, 0.0)], dt=0.4, speed=0.5)
poses = zip(path.T_map_sensor, path.T_map_base, strict=True)
scans = itertools.cycle([(camera.cast(scene, T)[None], T[None], T_base[None]) for T, T_base in poses])

emap = ElevationMap(ElevationMapConfig(grid=GridConfig(resolution=0.04, length_x=8.0, length_y=8.0)))
if not args.eager:
    emap.compile()
    emap.warm_up(num_points=camera.width * camera.height)  # takes minutes now, instead of at the first scan
height_scan, publisher = HeightScan.isaac_lab(), Publisher(emap, ("elevation",), rate=5.0)
slot, views, stop = queue.Queue(maxsize=1), queue.Queue(maxsize=1), threading.Event()


def sensor():
    while not stop.wait(PERIOD):
        if slot.empty():  # else the loop is late: this scan is dropped
            slot.put(next(scans))


def viewer():
    while (view := views.get()) is not None:
        view.layers["elevation"]  # draw or send it: a NumPy copy, which never changes


for target in (sensor, viewer):
    threading.Thread(target=target, daemon=True).start()
milliseconds, last, end = [], time.perf_counter(), time.perf_counter() + args.seconds
while last < end:
    points, T_map_sensor, T_map_base = slot.get()  # waits for a scan
    start = time.perf_counter()
    emap.update(points, T_map_sensor, T_map_base, dt=start - last)  # better: the difference of their time stamps
    observation, valid = height_scan(emap, T_map_base)  # (1, 187), for the policy
    milliseconds.append(1e3 * (time.perf_counter() - start))
    last = start
    publisher.offer()
    if (view := publisher.take()) is not None and views.empty():
        views.put(view)
stop.set()
views.put(None)
ms = np.array(milliseconds[10:] or milliseconds)  # the first ones fill caches
shown = ", ".join(f"p{q} {np.percentile(ms, q):.1f}" for q in (50, 90, 99)) + f", max {ms.max():.1f} ms"
print(f"{len(ms) / args.seconds:.0f} scans a second of {points.shape[1]} points; update and height scan: {shown}")
if args.picture:
    import matplotlib.pyplot as plt

    plt.figure(figsize=(6, 3), layout="constrained").subplots().hist(ms, bins=60)
    plt.gca().set(xlabel="update and height scan [ms]", ylabel="scans", title=shown)
    plt.savefig(args.picture, dpi=110)
