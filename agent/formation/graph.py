"""Formation graphs: their connected parts (PURE)."""

from __future__ import annotations

from typing import Any

from handfast.agent.formation.points import as_edges


def components(n: int, edges: Any) -> tuple[tuple[int, ...], ...]:
    """Connected parts of a graph of n vertices with edges (m, 2), each sorted, by their least vertex."""
    parent = list(range(n))

    def root(vertex: int) -> int:
        while parent[vertex] != vertex:
            parent[vertex] = parent[parent[vertex]]
            vertex = parent[vertex]
        return vertex

    for i, j in as_edges(edges).tolist():
        a, b = root(i), root(j)
        parent[max(a, b)] = min(a, b)
    parts: dict[int, list[int]] = {}
    for vertex in range(n):
        parts.setdefault(root(vertex), []).append(vertex)
    return tuple(tuple(part) for part in parts.values())


def connected(n: int, edges: Any) -> bool:
    """Whether edges (m, 2) join any two of n vertices by a path. One vertex alone is connected."""
    return len(components(n, edges)) <= 1
