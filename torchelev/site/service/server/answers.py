"""Messages of a merger to robots: greetings, acknowledgements, refusals, and the version of the site."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from torchelev.site.fusion.windows import Alignment
from torchelev.site.service.ledger import Sender, next_epoch
from torchelev.site.service.server.served_site import ServedSite
from torchelev.site.service.wire.alignment import write_alignment
from torchelev.site.service.wire.messages import encode, take_text


class Answer(NamedTuple):
    """A message to one robot, or to all."""

    robot: str | None  #: name; None: all
    payload: bytes  #: the message


class Answers:
    """Composes and signs answers.

    Args:
        site: that they are about.
        keys: of the robots, to sign with; None: nothing is signed.
    """

    def __init__(self, site: ServedSite, keys: Mapping[str, bytes] | None) -> None:
        self._site, self._keys = site, keys

    def _describe(self) -> dict[str, Any]:
        return {"site": self._site.id, "version": self._site.version, "time": self._site.time}

    def _sign(self, robot: str, header: Mapping[str, Any]) -> Answer:
        own = {**header, **self._describe()}
        return Answer(robot, encode(own, key=None if self._keys is None else self._keys.get(robot)))

    def welcome(self, robot: str, header: Mapping[str, Any]) -> Answer:
        """Greet a link, and give it its epoch."""
        own = {"kind": "welcome", "link": take_text(header, "link", 64), "resolution": self._site.resolution}
        return self._sign(robot, own | {"epoch": next_epoch(self._site.notes.get(robot))})

    def acknowledge(self, robot: str, contradictions: list[int] | None = None) -> Answer:
        """Acknowledge a robot's last merge; when repeated, contradictions are no longer known and given as -1."""
        note = self._site.notes[robot]
        counts = [-1] * len(note["offset"]) if contradictions is None else contradictions
        return self._sign(robot, {"kind": "merged", **note, "contradictions": counts})

    def refuse(self, robot: str, sender: Sender | None, reason: str, text: str) -> Answer:
        """Say why a message is not merged."""
        about = {} if sender is None else {"link": sender.link, "number": sender.number}
        return self._sign(robot, {"kind": "refused", **about, "reason": reason, "text": text})

    def announce(self) -> Answer:
        """Say which version the site has now."""
        return Answer(None, encode({"kind": "version"} | self._describe()))


def note_of(sender: Sender, alignment: Alignment, new_cells: list[int], own: slice) -> dict[str, Any]:
    """Return the note on a robot's message that the commit stores and the acknowledgement repeats."""
    return {**sender._asdict(), **write_alignment(alignment, own), "new_cells": new_cells[own]}
