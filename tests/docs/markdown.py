"""Markdown pages: their python blocks, what they link to, and how to run them.

A block runs if its language is python: ```` ```python ```` or ```` ```{code-block} python ````. The comment
`<!-- not run: REASON -->` in the lines before a block leaves it out. All blocks of a page share one namespace.
"""

import re
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
CODE = ("code-block", "code", "sourcecode")
_FENCE = re.compile(r"^(\s*)(`{3,}|~{3,}|:{3,})\s*(.*?)\s*$")
_NOT_RUN = re.compile(r"<!--\s*not run:(.*?)-->")
_LINK = re.compile(r"\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)")
_FILE = re.compile(
    r"\{(?:image|figure|include|literalinclude)\}\s+(\S+)|^\s*:link:\s+(\S+)$(?!\n\s*:link-type: (?:ref|any))",
    re.MULTILINE,
)


class Block(NamedTuple):
    """A fenced block of code."""

    line: int  #: of the page on which its code starts, from 1
    language: str
    code: str
    not_run: str | None  #: why it does not run


def pages() -> list[Path]:
    """Return the pages of the site: not what a build copies there, nor the index of the pictures."""
    other = (DOCS / "_build", DOCS / "notebooks", DOCS / "pictures")
    return sorted(path for path in DOCS.rglob("*.md") if not any(folder in path.parents for folder in other))


def code_blocks(text: str) -> list[Block]:
    """Return the blocks of code of a page, those inside of tabs and cards too."""
    lines, blocks, reason = text.split("\n"), [], None
    number = 0
    while number < len(lines):
        line, number = lines[number], number + 1
        fence = _FENCE.match(line)
        if mark := _NOT_RUN.search(line):
            reason = mark[1].strip()
        elif fence and fence[3]:
            language = _language(fence[3])
            if language is not None:
                end = _end(lines, number, fence[2])
                blocks.append(_block(lines[number:end], number, language, reason))
                number, reason = end + 1, None
        elif line.strip():
            reason = None
    return blocks


def _language(opening: str) -> str | None:
    """Return the language that a fence opens, None for a directive that holds more markdown."""
    directive = re.match(r"\{([\w:-]+)\}\s*(\S*)", opening)
    if directive is None:
        return opening.split()[0]
    return directive[2] if directive[1] in CODE else None


def _end(lines: list[str], start: int, fence: str) -> int:
    """Return the number of the line that closes a fence."""
    closing = re.compile(rf"^\s*{fence[0]}{{{len(fence)},}}\s*$")
    return next((n for n in range(start, len(lines)) if closing.match(lines[n])), len(lines))


def _block(lines: list[str], number: int, language: str, reason: str | None) -> Block:
    """Return a block without its directive's options and its indent."""
    options = 0
    while options < len(lines) and re.match(r"\s*:[\w-]+:", lines[options]):
        options += 1
    lines = lines[options:]
    indent = min((len(line) - len(line.lstrip()) for line in lines if line.strip()), default=0)
    return Block(number + options + 1, language, "\n".join(line[indent:] for line in lines), reason)


def run_blocks(path: Path, blocks: list[Block]) -> dict[str, object]:
    """Run blocks in order in one namespace. Errors name the page and its line."""
    names: dict[str, object] = {"__name__": "__main__"}
    for block in blocks:
        exec(compile("\n" * (block.line - 1) + block.code, path, "exec"), names)
    return names


def links(text: str) -> list[str]:
    """Return the relative targets of a page's links, pictures and includes, without anchors."""
    prose = re.sub(r"^(`{3,})[\w ]*\n.*?^\1\s*$", "", text, flags=re.DOTALL | re.MULTILINE)
    prose = re.sub(r"(`+)[^`\n](?:.*?[^`\n])?\1(?!`)", "", prose)
    found = _LINK.findall(prose) + [file or _page(link) for file, link in _FILE.findall(text)]
    targets = [target.partition("#")[0] for target in found if not re.match(r"[a-z]+:", target)]
    return [target for target in targets if target]


def _page(link: str) -> str:
    """Return the file of a card's link, which may leave `.md` out."""
    return link if "." in link.rpartition("/")[2] or ":" in link else f"{link}.md"
