"""Graphs rewritten before they are compiled: masks go between operators as bytes, and bytes are chosen as integers."""

from __future__ import annotations

from typing import Any

import torch


def choose_bytes_as_integers(graph: torch.fx.GraphModule) -> None:
    """Let `torch.where` choose bytes as integers of 32 bits: of bytes alone the compiler makes no vectors."""
    for node in graph.graph.find_nodes(op="call_function", target=torch.where):
        result = node.meta.get("example_value")
        if result is None or result.dtype != torch.uint8:
            continue
        with graph.graph.inserting_before(node):
            mask, *values = node.args
            values = [_converted(v, torch.int32) if isinstance(v, torch.fx.Node) else v for v in values]
            chosen = graph.graph.call_function(torch.where, (mask, *values))
            chosen.meta["example_value"] = result.to(torch.int32)
            node.replace_all_uses_with(_converted(chosen, torch.uint8))
        graph.graph.erase_node(node)
    graph.recompile()


def pass_bytes_on(graph: torch.fx.GraphModule) -> None:
    """Let bytes that `as_mask` made a mask of, and `as_bytes` bytes again, stay as they are.

    Operators take and return masks as bytes. The bytes must not change before they are used for the last time, and what
    is returned must be no argument.
    """
    places = {node: place for place, node in enumerate(graph.graph.nodes)}
    for node in graph.graph.find_nodes(op="call_method", target="to"):
        source = _bytes_of_mask(node)
        if source is None:
            continue
        last = max((places[user] for user in node.users), default=0)
        before = [user for user in source.users if places[user] <= last]
        if all(_reads(user, source) for user in before) and all(_reads(user, node) for user in node.users):
            node.replace_all_uses_with(source)
    graph.recompile()


def _reads(user: torch.fx.Node, value: torch.fx.Node) -> bool:
    """Tell whether a node certainly does nothing with a value but read it: no writing, and no view of it."""
    if user.op == "call_method":
        return user.target == "to" or (user.target == "copy_" and user.args[0] is not value)
    schema = getattr(user.target, "_schema", None)  # of operators; functions such as `setitem` have none
    if schema is None or any(r.alias_info is not None for r in schema.returns):
        return False
    given = dict(zip((a.name for a in schema.arguments), user.args, strict=False)) | user.kwargs
    written: list[torch.fx.Node] = []
    for argument in schema.arguments:
        if argument.alias_info is not None:
            torch.fx.node.map_arg(given.get(argument.name), written.append)
    return value not in written


def _bytes_of_mask(node: torch.fx.Node) -> torch.fx.Node | None:
    """Return the bytes that `as_bytes` makes again, if `node` is its last step and a mask of `as_mask` is its input."""
    steps: list[Any] = [node]
    for target, value in (("to", torch.uint8), ("to", torch.int32), ("gt", 0), ("to", torch.int32)):
        step = steps[-1]
        if not isinstance(step, torch.fx.Node) or step.target != target or step.args[1:] != (value,):
            return None
        steps.append(step.args[0])
    source = steps[-1]
    example = source.meta.get("example_value") if isinstance(source, torch.fx.Node) else None
    return source if example is not None and example.dtype == torch.uint8 else None


def _converted(node: torch.fx.Node, dtype: torch.dtype) -> torch.fx.Node:
    """Insert a conversion, with an example of its values: of graphs with a node that lacks one there is no cache."""
    new = node.graph.call_method("to", (node, dtype))
    new.meta["example_value"] = node.meta["example_value"].to(dtype)
    return new
