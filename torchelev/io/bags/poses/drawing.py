"""The tree of transforms as text."""

from __future__ import annotations

from torchelev.io.bags.poses.transforms import TransformTree


def draw_tree(tree: TransformTree) -> list[str]:
    """Return the tree as lines of text, children below their parents."""
    lines: list[str] = []
    for root in tree.frames:
        if tree.parent(root) is None:
            lines.append(root)
            _draw_below(tree, root, "", lines)
    return lines


def _draw_below(tree: TransformTree, parent: str, indent: str, lines: list[str]) -> None:
    children = tree.children(parent)
    for child in children:
        is_last = child == children[-1]
        lines.append(f"{indent}{'└─' if is_last else '├─'} {child} ({_kind(tree, child)})")
        _draw_below(tree, child, indent + ("   " if is_last else "│  "), lines)


def _kind(tree: TransformTree, frame: str) -> str:
    if tree.is_static(frame):
        return "static"
    num = len(tree.recorded_rows(frame))
    return ("1 pose" if num == 1 else f"{num:,} poses") + (
        ", all the same" if num > 1 and tree.is_constant(frame) else ""
    )
