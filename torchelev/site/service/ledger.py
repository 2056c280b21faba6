"""Which message of a robot counts: the merger's notes, which are part of the commit that holds the robot's cells."""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import Any, NamedTuple

from torchelev.site.service.wire.messages import take_count, take_text

TAKEN, SUPERSEDED, OTHER_SITE, LOST = "taken", "superseded", "other_site", "lost"

_TEXTS = {
    TAKEN: "another link began with this name at the same time; greet again",
    SUPERSEDED: "another link has this name since; give each robot a name of its own",
    OTHER_SITE: "the merger holds another site than the one that this robot has merged into; "
    "reset the map and make a new link",
    LOST: "the site lacks this robot's last merge, as after a rollback or a restored backup; "
    "reset the map and make a new link",
}


class Verdict(Enum):
    """What to do with a message of windows."""

    MERGE = "merge"  #: it is the next one
    AGAIN = "again"  #: it has been merged: acknowledge it again
    DROP = "drop"  #: an older one that arrived late
    REFUSE = "refuse"  #: it cannot be merged; the answer gives the reason


class Decision(NamedTuple):
    """A verdict, and the reason if it is refused."""

    verdict: Verdict  #: what to do
    reason: str = ""  #: key of the reason

    @property
    def text(self) -> str:
        """The reason as a sentence."""
        return _TEXTS[self.reason]


class Sender(NamedTuple):
    """Who sent a message, and which one it is."""

    epoch: int  #: which link of this robot, from 1 on
    link: str  #: random id of the link, as two may begin at once
    number: int  #: of the message, from 1 on


def sender_of(header: Mapping[str, Any]) -> Sender:
    """Return the sender of a message; MessageError if the header names none."""
    return Sender(take_count(header, "epoch"), take_text(header, "link", 64), take_count(header, "number"))


def next_epoch(note: Mapping[str, Any] | None) -> int:
    """Return the epoch of a robot's next link."""
    return 1 if note is None else note["epoch"] + 1


def decide(note: Mapping[str, Any] | None, sender: Sender, is_same_site: bool) -> Decision:
    """Return what to do with a message of windows.

    Args:
        note: of the robot's last merge: its epoch, link and number; None: it has merged nothing yet.
        sender: of the message.
        is_same_site: whether the robot means the site that is here.
    """
    if not is_same_site:
        return Decision(Verdict.REFUSE, OTHER_SITE)
    last = Sender(0, "", 0) if note is None else Sender(note["epoch"], note["link"], note["number"])
    if sender.epoch < last.epoch:
        return Decision(Verdict.REFUSE, SUPERSEDED)
    if sender.epoch > last.epoch:
        return Decision(Verdict.MERGE) if sender.number == 1 else Decision(Verdict.REFUSE, LOST)
    if sender.link != last.link:
        return Decision(Verdict.REFUSE, TAKEN if sender.number == 1 else SUPERSEDED)
    if sender.number == last.number:
        return Decision(Verdict.AGAIN)
    if sender.number < last.number:
        return Decision(Verdict.DROP)
    return Decision(Verdict.MERGE) if sender.number == last.number + 1 else Decision(Verdict.REFUSE, LOST)
