"""A graph of similarities: stretches of a sequence, how neighbours lie to one another, and loops between distant ones.

Levenberg-Marquardt on the group Sim(3). Normal equations are sparse: a chain of N nodes with L loops costs a step
O(N + N L) time and memory at most (fill-in of the loops), a few milliseconds for some hundred nodes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from logvggt_jax.geometry import log_derivative, similarity_adjoint, similarity_exp, similarity_log

# Residuals of a loop beyond this count hardly: so much of the depth, of the scale, or of a radian. At the optimum a
# true loop misses as much as each of the chain's links does, whose drift may be a tenth or more.
TOLERANCE = 0.3
_MOST_STEPS = 30
_DAMPING, _LARGEST_DAMPING = 1e-6, 1e6
# From convex to robust: every round's threshold is so many times smaller.
_NARROWING = 2.0


class Edges(NamedTuple):
    """Measured relations between nodes.

    Attributes:
      first, second: int [E], nodes.
      measured: [E, 4, 4] float64, `second` in the frame of `first`: inverse(S_first) S_second where nothing errs.
    """

    first: np.ndarray
    second: np.ndarray
    measured: np.ndarray


def chain(nodes: np.ndarray) -> Edges:
    """The relations of every node [N, 4, 4] with the next, as they are."""
    first = np.arange(len(nodes) - 1)
    return Edges(first, first + 1, np.linalg.inv(nodes[:-1]) @ nodes[1:])


def residuals(nodes: np.ndarray, edges: Edges) -> np.ndarray:
    """[E, 7] tangents by which nodes [N, 4, 4] and measurements differ; zero where they agree."""
    between = np.linalg.inv(nodes[edges.first]) @ nodes[edges.second]
    return similarity_log(np.linalg.inv(edges.measured) @ between)


def derivatives(nodes: np.ndarray, edges: Edges) -> tuple[np.ndarray, np.ndarray]:
    """[E, 7, 7] each: how the residuals move where the first, and the second, node S becomes S exp(x) with small x."""
    second = log_derivative(residuals(nodes, edges))
    between = np.linalg.inv(nodes[edges.second]) @ nodes[edges.first]
    return -second @ similarity_adjoint(between), second


def optimise(nodes: np.ndarray, loops: Edges) -> tuple[np.ndarray, np.ndarray]:
    """Nodes that fit the chain of their neighbours and the loops best, and how far each loop was believed.

    The chain is trusted. Loops have Geman-McClure weights, which begin convex and become robust step by step (graduated
    non-convexity): a loop that the others contradict ends without influence, however far the chain has drifted.

    Args:
      nodes: [N, 4, 4] float64, the first of which stays; neighbours lie to one another as the chain is to keep them.
        The unit of a node's frame should be the depth that is seen there, so that residuals are shares of it.
      loops: relations of distant nodes.

    Returns:
      The nodes [N, 4, 4], and weights [L] in [0, 1] of the loops.
    """
    links = chain(nodes)
    edges = Edges(*(np.concatenate(parts) for parts in zip(links, loops, strict=True)))
    weights = np.ones(len(edges.first))
    is_loop = np.arange(len(weights)) >= len(links.first)
    nodes = _fit(nodes, edges, weights)
    squared = (residuals(nodes, edges)[is_loop] ** 2).sum(-1)
    bound = max(2.0 * float(squared.max(initial=0.0)), TOLERANCE**2)
    while True:
        weights[is_loop] = (bound / (squared + bound)) ** 2
        nodes = _fit(nodes, edges, weights)
        squared = (residuals(nodes, edges)[is_loop] ** 2).sum(-1)
        if bound == TOLERANCE**2:
            return nodes, (bound / (squared + bound)) ** 2
        bound = max(bound / _NARROWING**2, TOLERANCE**2)


def _fit(nodes: np.ndarray, edges: Edges, weights: np.ndarray) -> np.ndarray:
    """Least squares with these weights [E], begun at `nodes`."""

    def cost(at: np.ndarray) -> float:
        return float(weights @ (residuals(at, edges) ** 2).sum(-1))

    damping, now = _DAMPING, cost(nodes)
    for _ in range(_MOST_STEPS):
        hessian, gradient = _normal_equations(nodes, edges, weights)
        while damping < _LARGEST_DAMPING:
            damped = hessian + damping * sparse.diags(hessian.diagonal())
            step = -splu(damped.tocsc()).solve(gradient).reshape(-1, 7)
            moved = np.concatenate([nodes[:1], nodes[1:] @ similarity_exp(step)])
            if (then := cost(moved)) < now:
                break
            damping *= 10.0
        else:
            return nodes
        nodes, gained, now = moved, now - then, then
        damping = max(damping / 10.0, _DAMPING)
        if gained <= 1e-12 * now or now <= 1e-24:
            break
    return nodes


def _normal_equations(nodes: np.ndarray, edges: Edges, weights: np.ndarray) -> tuple[sparse.csc_array, np.ndarray]:
    """Hessian and gradient of half the cost for all nodes but the first."""
    count, size = len(edges.first), 7 * len(nodes)
    root = np.sqrt(weights)
    values = root[:, None, None, None] * np.stack(derivatives(nodes, edges), axis=1)  # [E, 2, 7, 7]
    rows = np.broadcast_to(np.arange(7 * count).reshape(count, 1, 7, 1), values.shape)
    starts = 7 * np.stack([edges.first, edges.second], axis=1)
    columns = np.broadcast_to(starts[:, :, None, None] + np.arange(7), values.shape)
    jacobian = sparse.csc_array((values.ravel(), (rows.ravel(), columns.ravel())), shape=(7 * count, size))[:, 7:]
    return (jacobian.T @ jacobian).tocsc(), jacobian.T @ (root[:, None] * residuals(nodes, edges)).ravel()
