"""Probabilistic roadmaps: PRM* as OMPL grows it, asked for its shortest path."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from ompl import base
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

_QUESTIONS_PER_SAMPLE = 2
"""How often OMPL asks whether to end while it draws one sample."""


def shortest(
    planner: Any,
    information: Any,
    start: NDArray[np.float64],
    goal: NDArray[np.float64],
    clear: Callable[[NDArray[np.float64], NDArray[np.float64]], bool],
    samples: int,
) -> NDArray[np.float64] | None:
    """Corners (n, 3) of the shortest path from ``start`` to ``goal`` (3,) in a new roadmap, or None.

    ``planner`` is OMPL's PRM* for ``information``, which draws ``samples``; ``clear`` answers for an
    edge. PRM's own ``solve`` looks for solutions in a second thread, so that what it finds depends on
    the machine's load: here OMPL grows the roadmap in the thread that calls. Start and goal are then
    connected to as many neighbours as PRM* connects a sample to (Karaman and Frazzoli 2011, k-nearest).
    """
    asked = iter(range(_QUESTIONS_PER_SAMPLE * samples))
    planner.setup()
    planner.growRoadmapPtc(base.PlannerTerminationCondition(lambda: next(asked, None) is None))
    grown = base.PlannerData(information)
    planner.getPlannerData(grown)
    states = [grown.getVertex(index).getState() for index in range(grown.numVertices())]
    places = np.array([start, goal, *([state[axis] for axis in range(3)] for state in states)])
    edges = [(a + 2, b + 2) for a in range(len(states)) for b in grown.getEdges(a)]
    for end in (0, 1):
        edges += [(end, near) for near in _nearest(places, end) if clear(places[end], places[near])]
    if not edges:
        return None
    ends = np.array(edges)
    lengths = np.linalg.norm(places[ends[:, 0]] - places[ends[:, 1]], axis=1)
    graph = csr_array((lengths, (ends[:, 0], ends[:, 1])), shape=(len(places), len(places)))
    distances, before = dijkstra(graph, directed=False, indices=[0], return_predecessors=True)
    if not math.isfinite(distances[0, 1]):
        return None
    way = [1]
    while way[-1] != 0:
        way.append(int(before[0, way[-1]]))
    return places[way[::-1]]


def _nearest(places: NDArray[np.float64], index: int) -> NDArray[np.int64]:
    """The neighbours that PRM* would try to connect ``places[index]`` to."""
    dimensions = places.shape[1]
    count = math.ceil(math.e * (1.0 + 1.0 / dimensions) * math.log(len(places)))
    distances = np.linalg.norm(places - places[index], axis=1)
    nearest: NDArray[np.int64] = np.argsort(distances, kind="stable")[1 : count + 1]
    return nearest
