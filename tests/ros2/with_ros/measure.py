"""Latency, CPU and memory of the node in real ROS 2, at 10 Hz and at twice the rate that it can take.

`run.py FOLDER` sets the environment of ROS; `make bench-ros2` runs this and writes benchmarks/results/ros2.json.
"""

import json
import os
import sys
import time
from pathlib import Path

import numpy as np
import rclpy
from robot import Robot, to_cloud

POINTS, MINUTE = 43_074, 60.0  # [s]


class Measured(Robot):
    """Notes how old each map is when it arrives."""

    def __init__(self, *arguments):
        super().__init__(*arguments)
        self.ages, self.last = [], None

    def _hear(self, topic):
        keep = super()._hear(topic)

        def note(message):
            keep(message)
            stamp = message.header.stamp if topic == "points" else None
            if stamp is not None and stamp != self.last:
                self.last = stamp
                self.ages.append((time.monotonic(), time.time() - stamp.sec - 1e-9 * stamp.nanosec))

        return note

    def drive(self, rate, seconds):
        """Send clouds at a rate [Hz]."""
        rng = np.random.default_rng(0)
        clouds = [rng.uniform(-5, 5, (POINTS, 3)).astype(np.float32) * [1, 1, 0.01] - [0, 0, 0.8] for _ in range(8)]
        clouds = [cloud.astype(np.float32) for cloud in clouds]
        begin = due = time.monotonic()
        for k in range(int(rate * seconds)):
            now = time.time()
            self.send_poses(now, x=0.05 * k / rate)
            self.send("/lidar/points", to_cloud(clouds[k % 8], now, "lidar"))
            due += 1 / rate
            while time.monotonic() < due:
                rclpy.spin_once(self, timeout_sec=max(0.0, min(0.005, due - time.monotonic())))
        return begin

    def used(self):
        """CPU seconds and resident megabytes of the node."""
        ticks = Path(f"/proc/{self.process.pid}/stat").read_text().rsplit(")", 1)[1].split()
        seconds = (int(ticks[11]) + int(ticks[12])) / os.sysconf("SC_CLK_TCK")
        status = Path(f"/proc/{self.process.pid}/status").read_text()
        return seconds, int(status.split("VmRSS:")[1].split()[0]) / 1024


def percentiles(ages, begin, end):
    values = 1e3 * np.array([age for when, age in ages if begin <= when < end])
    return {"p50 [ms]": round(float(np.median(values)), 1), "p99 [ms]": round(float(np.quantile(values, 0.99)), 1),
            "maps": len(values)}  # fmt: skip


def counts_of(robot):
    return {name: robot.count(name) for name in ("received", "fused", "replaced", "without_transform", "unreadable")}


def main(prepared, out, minutes):
    """Measure, print and write JSON."""
    rclpy.init()
    settings = [
        "rate_points:=1000.0",
        "layers:=[elevation]",
        "rate_costmap:=0.0",
        "rate_height_scan:=0.0",
        "rate_diagnostics:=1.0",
    ]
    robot = Measured(prepared / "robot.yaml", "", [x for s in settings for x in ("-p", s)]
                     + ["-p", f"library:={(prepared / 'library').read_text()}"])  # fmt: skip
    robot.start(prepared / "log")
    cpu, _ = robot.used()
    begin = time.monotonic()
    robot.spin(10.0)
    idle = round(100 * (robot.used()[0] - cpu) / (time.monotonic() - begin), 1)
    robot.drive(10.0, 5.0)
    found = {"ros": os.environ["ROS_DISTRO"], "middleware": os.environ["RMW_IMPLEMENTATION"], "points": POINTS}
    found["idle cpu [%]"] = idle
    cpu, memory = robot.used()
    begin = robot.drive(10.0, MINUTE)
    end, (after, resident) = time.monotonic(), robot.used()
    found["10 Hz"] = percentiles(robot.ages, begin, end) | {
        "cpu [%]": round(100 * (after - cpu) / (end - begin), 1), "memory [MB]": [round(memory, 1), round(resident, 1)],
        **counts_of(robot),
    }  # fmt: skip
    robot.set(rate_points=1.0)  # as by default; above, each new map was published
    cpu, begin = robot.used()[0], robot.drive(10.0, 20.0)
    found["10 Hz"]["cpu at default rates [%]"] = round(100 * (robot.used()[0] - cpu) / (time.monotonic() - begin), 1)
    robot.set(rate_points=1000.0)
    rate = 2e3 / max(found["10 Hz"]["p50 [ms]"], 5.0)
    robot.spin(1.5)
    before = counts_of(robot)
    begin, (_, memory) = robot.drive(rate, minutes * MINUTE), robot.used()
    robot.spin(1.5)
    end = begin + minutes * MINUTE
    found["overload"] = {
        "rate [Hz]": round(rate, 1),
        "sent": int(rate * minutes * MINUTE),
        "minutes": minutes,
        "memory [MB]": round(memory, 1),
        "first 30 s": percentiles(robot.ages, begin, begin + 30.0),
        "last 30 s": percentiles(robot.ages, end - 30.0, end),
        **{name: number - before[name] for name, number in counts_of(robot).items()},
    }
    robot.stop()
    rclpy.shutdown()
    Path(out).write_text(json.dumps(found, indent=2) + "\n")
    print(json.dumps(found, indent=2))


if __name__ == "__main__":
    main(Path(sys.argv[1]), sys.argv[2], float(sys.argv[3]))
