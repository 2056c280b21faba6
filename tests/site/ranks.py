"""Processes that share a site, and what each of them does."""

import datetime
import functools
import multiprocessing
import os
import pickle
import signal
import time

import torch
import torch._dynamo.convert_frame  # once, and not in each process
import torch.distributed as dist

from tests.helpers import small_map
from tests.site.helpers import fill, live
from torchelev.site import LostRankError, SiteConfig, SiteMap
from torchelev.site.content.reading import LAYERS
from torchelev.site.storage.versioned import store
from torchelev.site.storage.versioned.repository import RefusedCommitError

NUM_ROBOTS = 11
CORNERS = [(0, 0), (12, -9), (20, 25), (-30, 6), (8, 20), (45, 30), (160, 0), (170, 8), (-8, -20), (25, 5), (-99, 70)]
GIVEN = 3, 7  # robots that start anew with what the site knows


def run_ranks(work, size, folder, *args):
    """Run work(rank, *args) in `size` processes; return what each returns or raises, None if it was killed."""
    context = multiprocessing.get_context("forkserver")  # imports once for all; tensorstore must not be forked
    context.set_forkserver_preload(["tests.site.ranks"])
    folder.mkdir(exist_ok=True)
    ranks = [context.Process(target=_run, args=(work, rank, size, folder, args)) for rank in range(size)]
    for process in ranks:
        process.start()
    for process in ranks:
        process.join(90)
    hung = [rank for rank, process in enumerate(ranks) if process.exitcode is None]
    for process in ranks:
        process.kill()
    assert not hung, f"ranks {hung} hang"
    files = [folder / f"{rank}.pickle" for rank in range(size)]
    return [pickle.loads(file.read_bytes()) if file.exists() else None for file in files]


def _run(work, rank, size, folder, args):
    torch.set_num_threads(1)
    os.environ["GLOO_SOCKET_IFNAME"] = "lo"
    store = dist.FileStore(str(folder / "store"), size)
    dist.init_process_group("gloo", store=store, rank=rank, world_size=size, timeout=datetime.timedelta(seconds=60))
    try:
        result = work(rank, *args)
    except Exception as error:
        result = error.with_traceback(None)
    part = folder / f"{rank}.part"
    part.write_bytes(pickle.dumps(result))
    part.rename(folder / f"{rank}.pickle")
    if work is not lose:  # a group that has lost a rank cannot be left in an orderly way
        dist.barrier()
        dist.destroy_process_group()
    os._exit(0)


# What robots do -------------------------------------------------------------------------------------------------------


def all_robots():
    return small_map(NUM_ROBOTS, (30, 26))


def measure(emap, step):
    """Let all robots measure for a second."""
    live(emap, 1.0)
    if step == 2:
        emap.reset(torch.tensor([1, 4]))
    corners = [(x + 3 * step, y - 2 * step) for x, y in CORNERS]
    offsets = torch.linspace(-0.1, 0.1, NUM_ROBOTS) + 0.01 * step
    fill(
        emap, corners, offsets=offsets, noise=0.004, known=0.3 if step == 3 else 0.8, std=0.01 + 0.002 * step, seed=step
    )
    emap.state.elevation[2, 5:9] += 0.4 * step  # contradicts itself
    emap.state.bounded.copy_(~emap.state.validity)
    emap.state.upper_bound.copy_(torch.where(emap.state.validity, 0.0, 1.5))
    emap.state.time[:, :, ::3] = 0.2


def take(part, emap, robots):
    """Copy some robots of a map to a map of these alone."""
    with torch.no_grad():
        for name, value in emap.state._asdict().items():
            if name != "statistics":
                getattr(part.state, name).copy_(value[robots])
        part.num_resets.copy_(emap.num_resets[robots])


def mission(site, robots, tilt=False):
    """Merge some of the robots several times; return the reports and what the site says in the end."""
    emap, part, reports = all_robots(), small_map(len(robots), (30, 26)), []
    for step in range(4):
        measure(emap, step)
        take(part, emap, robots)
        if step == 3:
            part.initialize_from(site, mask=torch.tensor([robot in GIVEN for robot in robots]))
        report = site.merge(part, tilt=tilt, time=100.0 + step if step == 1 else None)
        reports.append(tuple(value.numpy() for value in report))
    part.initialize_from(site)
    return reports, part.layer("elevation").numpy(), contents(site)


def contents(site):
    """All that a site says."""
    x_min, x_max, y_min, y_max = site.extent
    window = site.window(((x_min + x_max) / 2, (y_min + y_max) / 2), x_max - x_min, y_max - y_min)
    xy = 30 * torch.rand(500, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    sampled = [value.numpy() for name in LAYERS for value in site.sample(xy, name)]
    return {"time": site.time, "tiles": len(site), "sampled": sampled, **window.layers}


# What ranks do --------------------------------------------------------------------------------------------------------


def open_site(path, **options):
    return SiteMap(0.1, path, cfg=SiteConfig(cache_tiles=3), group=dist.group.WORLD, **options)


def fly(rank, path, shares, tilt):
    return mission(open_site(path), shares[rank], tilt)


def held(rank, path, shares):
    """Merge and read everything; return which tiles in memory are others' after the next merge, and the time of one."""
    site, emap, part = SiteMap(0.1, path, group=dist.group.WORLD), all_robots(), small_map(len(shares[rank]), (30, 26))
    for step in range(2):
        measure(emap, step)
        take(part, emap, shares[rank])
        site.merge(part)
        kept, size = site._are_of_others(list(site._tiles._slots)), len(site)
        contents(site)
    return kept, size, float(site.sample(torch.tensor([[1.0, 1.0]]), "time", "nearest")[0])


def one_robot(rank, step=0):
    emap = small_map(1, (30, 26))
    return fill(emap, [(40 * step + 10 * rank, 0)], lambda x, y: 0.1 * x + step)


def races(rank, path, slow):
    """Merge the same robots twice; one rank is slow where another could overtake it."""
    site, seen, emap = open_site(path), [], one_robot(rank)
    read, commit = site._tiles.read, store.commit
    if slow == "reading" and rank == 1:
        site._tiles.read = lambda tiles: (time.sleep(0.3), site._tiles.forget(), read(tiles))[2]
    if slow == "writing" and rank == 0:
        store.commit = lambda *args: (time.sleep(0.3), commit(*args), time.sleep(0.1))[1]
    for _ in range(3):
        fill(emap, [(10 * rank, 0)], lambda x, y: 0.1 * x)
        emap.state.elapsed.add_(10**9)
        site.merge(emap)
        site._tiles.forget() if slow == "writing" else None
        seen.append(site.sample(emap.cell_centers()[0].flatten(0, 1), "variance", "nearest")[0].numpy())
    return seen


def lose(rank, path, how):
    """Merge once; then one rank ends, and the others call again."""
    site = open_site(path)
    site.merge(one_robot(rank))
    how, lost, *_ = how.split()
    if rank == int(lost):
        _end(how)
    if how == "hangs":  # from here on, or a rank that starts late would count as lost
        dist.distributed_c10d._set_pg_timeout(datetime.timedelta(seconds=1.0), dist.group.WORLD)
    start = time.monotonic()
    texts = []
    for _ in range(2):
        try:
            site.merge(one_robot(rank, step=1))
        except LostRankError as error:
            texts.append(str(error))
    return texts, time.monotonic() - start, contents(site)


def _end(how):
    if how == "exits":
        os._exit(1)
    if how == "killed":
        os.kill(os.getpid(), signal.SIGKILL)
    if how == "hangs":
        time.sleep(3.0)
        os._exit(1)
    if how == "before_commit":
        store.commit = lambda *args: os.kill(os.getpid(), signal.SIGKILL)


def misuse(rank, path, other):
    """Return the texts of errors, and what the site holds before and after."""
    cases = {
        "resolution": lambda: SiteMap(0.1 + 0.1 * rank, group=dist.group.WORLD),
        "no resolution": lambda: SiteMap(-0.1 * rank or 0.1, group=dist.group.WORLD),
        "cfg": lambda: SiteMap(0.1, cfg=SiteConfig(gate=5.0 + rank), group=dist.group.WORLD),
        "path": lambda: SiteMap(0.1, other if rank else None, group=dist.group.WORLD),
        "absent": lambda: SiteMap(0.1, other / f"{rank}", group=dist.group.WORLD),
        "another site": lambda: open_site([path, other][rank]),
        "site's resolution": lambda: SiteMap(0.2, path, group=dist.group.WORLD),
    }
    texts = {name: _error_of(call) for name, call in cases.items()}
    site, emap = open_site(path), one_robot(rank, step=2 * rank)  # so that each rank has a tile
    before = contents(site)
    merge = functools.partial(site.merge, emap)
    cases = {
        "emap's resolution": lambda: site.merge(small_map(1, (30, 26), resolution=0.1 - 0.05 * rank)),
        "window": lambda: site.merge(small_map(1, (30, 26 + 2 * rank))),
        "type": lambda: site.merge("map" if rank else emap),
        "align": lambda: merge(align=not rank),
        "tilt": lambda: merge(tilt=bool(rank)),
        "given": lambda: merge(time=5.0 if rank else None),
        "call": lambda: merge() if rank else SiteMap(group=dist.group.WORLD),
        "disk": lambda: _with_full_disk(merge),
        "reading": lambda: _unreadable(site, merge, rank),
        "beginning": lambda: _failing(site._store, "_alone", merge, rank == 0),
        "writing": lambda: _failing(store, "write_tiles", merge, rank == 1),
    }
    texts |= {name: _error_of(call) for name, call in cases.items()}
    after = contents(site)
    return texts, before, after, site.merge(emap).new_cells.tolist()


def _error_of(call):
    try:
        call()
    except Exception as error:
        return type(error).__mro__[-4 if isinstance(error, OSError) else 0].__name__, str(error)
    return "nothing"


def _with_full_disk(merge):
    def fail(*args):
        import icechunk

        raise RefusedCommitError("site", icechunk.IcechunkError("object store error: No space left on device"))

    commit, store.commit = store.commit, fail
    try:
        merge()
    finally:
        store.commit = commit


def _failing(thing, name, merge, is_failing):
    def fail(*args):
        raise ValueError(f"{name} must succeed")

    original = getattr(thing, name)
    setattr(thing, name, fail if is_failing else original)
    try:
        merge()
    finally:
        setattr(thing, name, original)


def _unreadable(site, merge, rank):
    def fail(tiles):
        raise ValueError("tile (0, 0): must be readable")

    read = site._tiles.read
    site._tiles.read = fail if rank else read
    try:
        merge()
    finally:
        site._tiles.read = read
