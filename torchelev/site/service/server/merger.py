"""The merger: it takes messages, decides which count, merges them and answers. The network is in `transport`."""

from __future__ import annotations

import time as clocks
from collections import Counter
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchelev.errors import message
from torchelev.site.fusion.merge import MergeReport
from torchelev.site.fusion.windows import Alignment
from torchelev.site.service.ledger import Decision, Sender, Verdict, decide, sender_of
from torchelev.site.service.questions import answer_question
from torchelev.site.service.server.answers import Answer, Answers, note_of
from torchelev.site.service.server.inbox import Entry, Inbox
from torchelev.site.service.server.served_site import ServedSite
from torchelev.site.service.wire.access import ForbiddenError, check_keys, check_sender
from torchelev.site.service.wire.messages import Message, MessageError, OtherVersionError, decode, take_text
from torchelev.site.service.wire.windows import Received, from_message, join
from torchelev.site.site_config import SiteConfig
from torchelev.site.storage import engines
from torchelev.site.storage.engines import Engine
from torchelev.site.storage.interface import Overtaken

_MAX_AHEAD = 10.0  # [s] of a robot's clock before the merger's
_MOST_CELLS = 1 << 22  # of the windows that are merged at a time


class Merged(NamedTuple):
    """A merge of the windows that some robots sent."""

    robots: list[str]  #: names
    new_cells: int  #: measured since their last merges
    contradictions: int  #: of these, cells whose height contradicts another one
    version: str  #: of the site after it
    seconds: float  #: [s] that it took


class _Waiting(NamedTuple):
    """A message that counts."""

    robot: str
    sender: Sender
    received: Received


class SiteServer:
    """Holds a site and merges what robots send. `NetworkedServer` connects it to them.

    It keeps nothing but the site: a server that is killed and started again goes on where the last commit is.

    Args:
        path: folder or s3://bucket/prefix of the site, made if it is not there, which needs ``torchelev[site]``; None:
            in memory.
        resolution: [m] of a new site; None: that of the folder, or 0.1.
        cfg: how windows are aligned and fused.
        device: that fuses.
        engine: of a new site, as of `SiteMap`.
        keys: a key for each robot that may write, of at least 16 characters; messages are signed with them. None: all
            robots may write that reach the server.
        align: find the robots' height offsets; otherwise their heights count as they are.
        tilt: also find how their windows tilt.
        clock: returns the time [s] on the clock that all robots share. Messages more than 10 s ahead are refused.

    Attributes:
        site: that it holds; read it in the thread that calls `step`, or from another process.
        counts: number of messages by outcome: "merged", "repeated", "late", "refused", "damaged", "overflow".
        on_merge: called with each `Merged`; None: nobody.

    Raises:
        ValueError: the site has another resolution, keeps channels, levels or keyframes, or a key is too short.
        OSError: the folder or object store cannot be written, or another process writes to a site of files.
        ModuleNotFoundError: the engine is missing.
    """

    def __init__(
        self,
        path: str | Path | None,
        *,
        resolution: float | None = None,
        cfg: SiteConfig | None = None,
        device: torch.device | str = "cpu",
        engine: Engine | None = None,
        keys: Mapping[str, str] | None = None,
        align: bool = True,
        tilt: bool = False,
        clock: Callable[[], float] = clocks.time,
    ) -> None:
        self._keys, self._align, self._tilt, self._clock = check_keys(keys), align, tilt, clock
        self.site = _open(path, resolution, cfg, device, engine)
        self._answers = Answers(self.site, self._keys)
        self.counts: Counter[str] = Counter()
        self.on_merge: Callable[[Merged], None] | None = None
        self._inbox = Inbox()

    # Messages come in -----------------------------------------------------------------------------------------------

    def handle(self, payload: bytes, robot: str | None = None) -> None:
        """Take a message, from any thread; `step` answers it.

        Args:
            payload: its bytes.
            robot: under whose name the network delivered it: a message of another one is refused. None: not known.
        """
        self._inbox.put(Entry(payload, robot, None))

    def ask(self, payload: bytes, answer: Callable[[bytes], None]) -> None:
        """Take a question about the site, from any thread; `step` calls `answer`."""
        self._inbox.put(Entry(payload, None, answer))

    def wake(self) -> None:
        """End a wait of `step`."""
        self._inbox.wake()

    def step(self, timeout: float = 0.0) -> list[Answer]:
        """Merge the messages that have arrived, and return the answers. Call it from one thread.

        Args:
            timeout: [s] to wait for a message.

        Raises:
            OSError: the disk is full. The site is as it was before, and the robots send again.
        """
        answers, waiting = [], dict[str, _Waiting]()
        for entry in self._inbox.take_all(timeout):
            if entry.answer is not None:
                entry.answer(answer_question(self.site, entry.payload))
            else:
                answers += self._take(entry, waiting)
        self.counts["overflow"] = self._inbox.num_dropped
        return answers + self._merge_all(list(waiting.values()))

    def _take(self, entry: Entry, waiting: dict[str, _Waiting]) -> list[Answer]:
        """Answer a message, or let it wait to be merged."""
        try:
            received = decode(entry.payload)
            robot = check_sender(received, entry.robot, self._keys)
            kind = take_text(received.header, "kind")
            if kind == "hello":
                return [self._answers.welcome(robot, received.header)]
            if kind != "windows":
                raise MessageError(f"message: must be hello or windows, got {kind}")
            return self._take_windows(robot, received, waiting)
        except OtherVersionError as error:
            return [] if entry.robot is None else [self._refuse(entry.robot, None, "version", str(error))]
        except ForbiddenError:
            self.counts["refused"] += 1
        except MessageError:
            self.counts["damaged"] += 1
        return []

    def _take_windows(self, robot: str, received: Message, waiting: dict[str, _Waiting]) -> list[Answer]:
        """Let windows wait to be merged if they count, or answer why they do not."""
        sender = sender_of(received.header)
        decision = decide(self.site.notes.get(robot), sender, received.header.get("site") == self.site.id)
        if decision.verdict is not Verdict.MERGE:
            return self._answer(robot, sender, decision)
        if robot in waiting:
            self.counts["repeated"] += 1
            return []
        windows = from_message(received)
        measured, now = float(windows.windows.known.now.max()), self._clock()
        if measured > now + _MAX_AHEAD:
            rule = "must be on the clock that all robots and the merger share"
            text = message("time", rule, f"{measured:.1f} s at {now:.1f} s", "set the robot's clock")
            return [self._refuse(robot, sender, "time", text)]
        waiting[robot] = _Waiting(robot, sender, windows)
        return []

    def _answer(self, robot: str, sender: Sender, decision: Decision) -> list[Answer]:
        """Answer a message that is not merged."""
        if decision.verdict is Verdict.AGAIN:
            self.counts["repeated"] += 1
            return [self._answers.acknowledge(robot)]
        if decision.verdict is Verdict.REFUSE:
            return [self._refuse(robot, sender, decision.reason, decision.text)]
        self.counts["late" if decision.verdict is Verdict.DROP else "repeated"] += 1
        return []

    def _refuse(self, robot: str, sender: Sender | None, reason: str, text: str) -> Answer:
        self.counts["refused"] += 1
        return self._answers.refuse(robot, sender, reason, text)

    # Merging --------------------------------------------------------------------------------------------------------

    def _merge_all(self, waiting: list[_Waiting]) -> list[Answer]:
        """Merge all that wait, windows of the same size together."""
        answers, groups = [], dict[tuple[int, ...], list[_Waiting]]()
        for each in waiting:
            groups.setdefault(tuple(each.received.windows.known.elevation.shape[1:]), []).append(each)
        for (height, width), group in groups.items():
            most = max(1, _MOST_CELLS // (height * width))
            for k in range(0, len(group), most):
                answers += self._merge_or_refuse(group[k : k + most])
        return answers

    def _merge_or_refuse(self, group: list[_Waiting]) -> list[Answer]:
        """Merge some messages; if that is impossible, each one alone, and refuse those that cannot be merged."""
        try:
            while True:
                try:
                    return self._merge(group)
                except Overtaken:  # by another process, whose notes may have some of these messages
                    self.site.refresh()
        except OSError:  # a commit whose connection ended may be stored: its notes show it
            with suppress(OSError):
                self.site.refresh()
            raise
        except (ValueError, RuntimeError) as error:
            if len(group) > 1:
                return [answer for each in group for answer in self._merge_or_refuse([each])]
            text = f"its windows cannot be merged ({error})"
            return [self._refuse(group[0].robot, group[0].sender, "unusable", text)]

    def _merge(self, group: list[_Waiting]) -> list[Answer]:
        """Merge some messages in one commit, in turn with other writers; return what to answer."""
        start = clocks.perf_counter()
        with self.site.turn():
            answers, group = self._decide_again(group)
            return answers + (self._merge_now(group, start) if group else [])

    def _decide_again(self, group: list[_Waiting]) -> tuple[list[Answer], list[_Waiting]]:
        """Return answers to the messages that other processes have merged meanwhile, and those that still count."""
        answers, left = list[Answer](), list[_Waiting]()
        for each in group:
            decision = decide(self.site.notes.get(each.robot), each.sender, True)
            if decision.verdict is Verdict.MERGE:
                left.append(each)
            else:
                answers += self._answer(each.robot, each.sender, decision)
        return answers, left

    def _merge_now(self, group: list[_Waiting], start: float) -> list[Answer]:
        """Merge messages that count; return their acknowledgements and the new version."""
        received = join([each.received for each in group])
        sizes = [len(each.received.offset) for each in group]
        ends = torch.tensor(sizes).cumsum(0).tolist()
        new_cells = received.windows.is_new.flatten(1).sum(1)

        def note(alignment: Alignment) -> dict[str, Any]:
            return {
                each.robot: note_of(each.sender, alignment, new_cells.tolist(), slice(end - size, end))
                for each, size, end in zip(group, sizes, ends, strict=True)
            }

        report = self.site.merge_received(received, note, align=self._align, tilt=self._tilt)
        self.counts["merged"] += len(group)
        if self.on_merge is not None:
            seconds = clocks.perf_counter() - start
            numbers = int(new_cells.sum()), int(report.contradictions.sum())
            self.on_merge(Merged([each.robot for each in group], *numbers, self.site.version, seconds))
        parts = [
            self._answers.acknowledge(each.robot, _slice(report, end - size, end))
            for each, size, end in zip(group, sizes, ends, strict=True)
        ]
        return [*parts, self._answers.announce()]

    def close(self) -> None:
        """Let other processes write to the site's folder; all that was acknowledged is on disk."""
        self.site.close()


def _open(
    path: str | Path | None,
    resolution: float | None,
    cfg: SiteConfig | None,
    device: torch.device | str,
    engine: Engine | None,
) -> ServedSite:
    """Open a site, or make it."""
    if path is not None and resolution is None and engines.exists(path):
        site = ServedSite.open(path, cfg=cfg, device=device)
    else:
        site = ServedSite(0.1 if resolution is None else resolution, path, cfg=cfg, device=device, engine=engine)
    try:
        site.require_heights_alone()
        with site.turn():  # now, and not at the first message: can it be written?
            pass
    except (ValueError, OSError):
        site.close()
        raise
    return site


def _slice(report: MergeReport, start: int, end: int) -> list[int]:
    return report.contradictions[start:end].tolist()
