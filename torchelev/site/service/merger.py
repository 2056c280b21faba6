"""The merger: it takes messages, decides which count, merges them and answers. The network is in `transport`."""

from __future__ import annotations

import time as clocks
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import torch

from torchelev.errors import message
from torchelev.site.fusion.merge import MergeReport
from torchelev.site.fusion.windows import Alignment
from torchelev.site.service.access import check_keys, check_name
from torchelev.site.service.inbox import Entry, Inbox
from torchelev.site.service.ledger import Decision, Sender, Verdict, decide, next_epoch, sender_of
from torchelev.site.service.messages import Message, MessageError, OtherVersionError, decode, encode, take_text
from torchelev.site.service.questions import answer_question
from torchelev.site.service.served_site import ServedSite
from torchelev.site.service.windows_message import Received, from_message, join
from torchelev.site.site_config import SiteConfig

_MAX_AHEAD = 10.0  # [s] of a robot's clock before the merger's
_MOST_CELLS = 1 << 22  # of the windows that are merged at a time


class Answer(NamedTuple):
    """What the merger tells a robot, or all."""

    robot: str | None  #: name; None: all
    payload: bytes  #: the message


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
        path: folder of the site, made if it is not there, which needs ``torchelev[site]``; None: in memory.
        resolution: [m] of a new site; None: that of the folder, or 0.1.
        cfg: how windows are aligned and fused.
        device: that fuses.
        keys: a key for each robot that may write, of at least 16 characters; messages are signed with them. None: all
            robots may write that reach the server.
        align: find the robots' height offsets; otherwise their heights count as they are.
        tilt: also find how their windows tilt.
        clock: returns the time [s] on the clock that all robots share. Messages more than 10 s ahead are refused.

    Attributes:
        site: that it holds; read it in the thread that calls `step`, or from another process.
        counts: messages by what became of them: "merged", "repeated", "late", "refused", "damaged", "overflow".
        on_merge: called with each `Merged`; None: nobody.

    Raises:
        ValueError: the site has another resolution, keeps channels, levels or keyframes, or a key is too short.
        OSError: another process writes to the folder.
        ModuleNotFoundError: tensorstore is missing.
    """

    def __init__(
        self,
        path: str | Path | None,
        *,
        resolution: float | None = None,
        cfg: SiteConfig | None = None,
        device: torch.device | str = "cpu",
        keys: Mapping[str, str] | None = None,
        align: bool = True,
        tilt: bool = False,
        clock: Callable[[], float] = clocks.time,
    ) -> None:
        self._keys, self._align, self._tilt, self._clock = check_keys(keys), align, tilt, clock
        self.site = _open(path, resolution, cfg, device)
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
        """Merge what has come, and return what to tell whom. Call it from one thread.

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
            robot = self._check_access(received, entry.robot)
            kind = take_text(received.header, "kind")
            if kind == "hello":
                return [self._welcome(robot, received.header)]
            if kind != "windows":
                raise MessageError(f"message: must be hello or windows, got {kind}")
            return self._take_windows(robot, received, waiting)
        except OtherVersionError as error:
            return [] if entry.robot is None else [self._refuse(entry.robot, {}, "version", str(error))]
        except _ForbiddenError:
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
            return [self._refuse(robot, _about(sender), "time", text)]
        waiting[robot] = _Waiting(robot, sender, windows)
        return []

    def _check_access(self, received: Message, robot: str | None) -> str:
        """Return the robot of a message; raise unless it may send it."""
        try:
            name = check_name("robot", received.header.get("robot"))
        except ValueError as error:
            raise MessageError(str(error)) from error
        if robot is not None and robot != name:
            raise _ForbiddenError(f"{robot} sent windows of {name}")
        key = None if self._keys is None else self._keys.get(name)
        if self._keys is not None and (key is None or not received.is_signed_with(key)):
            raise _ForbiddenError(f"{name} has another key, or none")
        return name

    def _answer(self, robot: str, sender: Sender, decision: Decision) -> list[Answer]:
        """Answer a message that is not merged."""
        if decision.verdict is Verdict.AGAIN:
            self.counts["repeated"] += 1
            return [self._acknowledge(robot, self.site.notes[robot])]
        if decision.verdict is Verdict.REFUSE:
            return [self._refuse(robot, _about(sender), decision.reason, decision.text)]
        self.counts["late" if decision.verdict is Verdict.DROP else "repeated"] += 1
        return []

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
            return self._merge(group)
        except (ValueError, RuntimeError) as error:
            if len(group) > 1:
                return [answer for each in group for answer in self._merge_or_refuse([each])]
            text = f"its windows cannot be merged ({error})"
            return [self._refuse(group[0].robot, _about(group[0].sender), "unusable", text)]

    def _merge(self, group: list[_Waiting]) -> list[Answer]:
        """Merge some messages in one commit; return their acknowledgements and the new version."""
        start, received = clocks.perf_counter(), join([each.received for each in group])
        sizes = [len(each.received.offset) for each in group]
        ends = torch.tensor(sizes).cumsum(0).tolist()
        new_cells = received.windows.is_new.flatten(1).sum(1)

        def note(alignment: Alignment) -> dict[str, Any]:
            return {
                each.robot: _note(each.sender, alignment, new_cells.tolist(), slice(end - size, end))
                for each, size, end in zip(group, sizes, ends, strict=True)
            }

        report = self.site.merge_received(received, note, align=self._align, tilt=self._tilt)
        self.counts["merged"] += len(group)
        if self.on_merge is not None:
            seconds = clocks.perf_counter() - start
            numbers = int(new_cells.sum()), int(report.contradictions.sum())
            self.on_merge(Merged([each.robot for each in group], *numbers, self.site.version, seconds))
        parts = [
            self._acknowledge(each.robot, self.site.notes[each.robot], _slice(report, end - size, end))
            for each, size, end in zip(group, sizes, ends, strict=True)
        ]
        return [*parts, self._announce()]

    # Answers --------------------------------------------------------------------------------------------------------

    def _describe(self) -> dict[str, Any]:
        """Return what each answer says of the site."""
        return {"site": self.site.id, "version": self.site.version, "time": self.site.time}

    def _sign(self, robot: str, header: Mapping[str, Any]) -> Answer:
        return Answer(robot, encode(header, key=None if self._keys is None else self._keys.get(robot)))

    def _welcome(self, robot: str, header: Mapping[str, Any]) -> Answer:
        own = {"kind": "welcome", "link": take_text(header, "link", 64), "resolution": self.site.resolution}
        return self._sign(robot, own | self._describe() | {"epoch": next_epoch(self.site.notes.get(robot))})

    def _acknowledge(self, robot: str, note: Mapping[str, Any], contradictions: list[int] | None = None) -> Answer:
        """Acknowledge a robot's last merge; repeated, the contradictions are not known any more: -1."""
        counts = [-1] * len(note["offset"]) if contradictions is None else contradictions
        return self._sign(robot, {"kind": "merged", **note, "contradictions": counts} | self._describe())

    def _refuse(self, robot: str, about: Mapping[str, Any], reason: str, text: str) -> Answer:
        self.counts["refused"] += 1
        return self._sign(robot, {"kind": "refused", **about, "reason": reason, "text": text} | self._describe())

    def _announce(self) -> Answer:
        return Answer(None, encode({"kind": "version"} | self._describe()))

    def close(self) -> None:
        """Let other processes write to the site's folder; all that was acknowledged is on disk."""
        self.site.close()


class _ForbiddenError(Exception):
    """A robot may not send this. It is not answered: whoever has no key learns nothing."""


def _about(sender: Sender) -> dict[str, Any]:
    """Return which message a refusal is of."""
    return {"link": sender.link, "number": sender.number}


def _open(
    path: str | Path | None, resolution: float | None, cfg: SiteConfig | None, device: torch.device | str
) -> ServedSite:
    """Open a site, or make it."""
    if path is not None and resolution is None and Path(path).is_dir() and any(Path(path).iterdir()):
        site = ServedSite.open(path, cfg=cfg, device=device)
    else:
        site = ServedSite(0.1 if resolution is None else resolution, path, cfg=cfg, device=device)
    try:
        site.require_heights_alone()
    except ValueError:
        site.close()
        raise
    return site


def _note(sender: Sender, alignment: Alignment, new_cells: list[int], own: slice) -> dict[str, Any]:
    """Return what the commit notes of a robot's message."""
    offset, tilt, is_isolated = (value[own].tolist() for value in alignment)
    lies = {"offset": offset, "tilt": tilt, "isolated": is_isolated}
    return {**sender._asdict(), **lies, "new_cells": new_cells[own]}


def _slice(report: MergeReport, start: int, end: int) -> list[int]:
    return report.contradictions[start:end].tolist()
