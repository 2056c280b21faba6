"""A site as a service: robots publish windows over Zenoh, and one process merges them. Needs ``torchelev[serve]``.

- `server`: the process that holds the site, `SiteServer`. `ledger` decides which message counts.
- `robot`: `RobotLink` publishes what a map measures. `outbox` keeps it as `snapshots` until the site has it.
- `reader`: `SiteReader` reads areas of the site from anywhere, by `questions`.
- `wire`: messages as bytes, keys of robots, and Zenoh.

Fusing is not here, see `torchelev.site.fusion`, nor are processes that share a site, see `torchelev.site.shared`.

**Why nothing counts twice and nothing is lost.** A robot sends one message at a time, number 1, 2, 3, ..., and the same
one again until it is acknowledged. The merger notes the number of each robot's last message in the commit that holds
its cells, so that both are on disk or neither: a message with that number is acknowledged again but not merged, one
with an older number is dropped, and only the next number is merged. How the earlier share of a cell is replaced is
known to the robot, from the acknowledgements, and travels with its message: a merger that starts again needs no other
memory than the site.
"""

from torchelev.site.service.outbox import RefusedError
from torchelev.site.service.reader import SiteReader
from torchelev.site.service.robot import RobotLink
from torchelev.site.service.server.merger import SiteServer
from torchelev.site.service.server.serve import NetworkedServer

__all__ = ["NetworkedServer", "RefusedError", "RobotLink", "SiteReader", "SiteServer"]
