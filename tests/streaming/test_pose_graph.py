"""The graph of similarities: derivatives, a known optimum, and loops that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

from logvggt_jax.geometry import similarity_exp, similarity_log
from logvggt_jax.streaming.pose_graph import Edges, chain, derivatives, optimise, residuals

STEP = np.array([0.5, 0.0, 0.0, 0.0, 2 * np.pi / 20, 0.0, 0.0])
DRIFT = np.array([0.02, 0.0, 0.01, 0.0, 0.02, 0.01, 0.02])
WRONG = similarity_exp(np.array([2.0, 1.0, 0.0, 0.5, 1.0, 0.0, 0.3]))


def walked(steps: np.ndarray) -> np.ndarray:
    """Nodes [N + 1, 4, 4] of N steps."""
    nodes = [np.eye(4)]
    for step in steps:
        nodes.append(nodes[-1] @ similarity_exp(step))
    return np.stack(nodes)


@pytest.fixture(scope="module")
def truth() -> np.ndarray:
    """Twice round a circle of twenty nodes."""
    return walked(np.tile(STEP, (39, 1)))


@pytest.fixture(scope="module")
def apart() -> np.ndarray:
    """The same with drift."""
    noise = np.random.default_rng(0).normal(size=(39, 7)) * 0.003
    return walked(np.array([similarity_log(similarity_exp(STEP) @ similarity_exp(DRIFT + each)) for each in noise]))


def true_loops(truth: np.ndarray, *pairs: tuple[int, int]) -> Edges:
    first, second = np.array(pairs).T
    return Edges(first, second, np.linalg.inv(truth[first]) @ truth[second])


def error(nodes: np.ndarray, truth: np.ndarray) -> float:
    return float(np.linalg.norm((nodes - truth)[:, :3, 3], axis=1).mean())


def test_derivatives_are_the_limits_of_differences() -> None:
    generator = np.random.default_rng(0)
    nodes = similarity_exp(generator.normal(size=(6, 7)) * [3, 3, 3, 0.5, 0.5, 0.5, 0.3])
    measured = similarity_exp(generator.normal(size=(4, 7)))
    edges = Edges(np.array([0, 1, 2, 4]), np.array([3, 2, 5, 1]), measured)
    step = 1e-6
    for ends, found in zip((edges.first, edges.second), derivatives(nodes, edges), strict=True):
        for edge, node in enumerate(ends):
            for axis in range(7):
                moved = []
                for sign in (1.0, -1.0):
                    other = nodes.copy()
                    other[node] = other[node] @ similarity_exp(sign * step * np.eye(7)[axis])
                    moved.append(residuals(other, edges)[edge])
                expected = (moved[0] - moved[1]) / (2 * step)
                np.testing.assert_allclose(found[edge, :, axis], expected, atol=1e-6)


def test_a_loop_shares_what_is_missing_among_all() -> None:
    """Turns about one axis and scales commute: all ten relations, the loop among them, miss a tenth of the whole."""
    step, missing = np.array([0, 0, 0, 0, 0.2, 0, 0.05]), np.array([0, 0, 0, 0, 0.01, 0, -0.02])
    nodes = walked(np.tile(step, (9, 1)))
    moved, weights = optimise(nodes, Edges(np.array([0]), np.array([9]), similarity_exp(9 * step - missing)[None]))
    expected = similarity_exp(np.arange(10)[:, None] * (step - missing / 10))
    np.testing.assert_allclose(moved, expected, atol=1e-5)
    assert weights == pytest.approx(1.0, abs=2e-3)
    np.testing.assert_array_equal(moved[0], nodes[0])


def test_loops_that_agree_with_the_chain_change_nothing(truth: np.ndarray) -> None:
    moved, weights = optimise(truth, true_loops(truth, (0, 20), (10, 30)))
    np.testing.assert_allclose(moved, truth, atol=1e-9)
    np.testing.assert_allclose(weights, 1.0)
    assert np.abs(residuals(truth, chain(truth))).max() < 1e-12


def test_true_loops_are_closed_and_a_wrong_one_is_ignored(truth: np.ndarray, apart: np.ndarray) -> None:
    loops = true_loops(truth, (0, 20), (5, 25), (10, 30), (15, 35), (0, 39))
    closed, weights = optimise(apart, loops)
    assert error(closed, truth) < error(apart, truth) / 3 and weights.min() > 0.5
    more = Edges(np.append(loops.first, 3), np.append(loops.second, 33), np.append(loops.measured, WRONG[None], axis=0))
    again, weights = optimise(apart, more)
    assert weights[:5].min() > 0.5 and weights[5] < 1e-3
    np.testing.assert_allclose(again, closed, atol=0.01)


def test_a_wrong_loop_alone_has_no_weight_where_the_chain_cannot_give_way(truth: np.ndarray) -> None:
    moved, weights = optimise(truth, Edges(np.array([3]), np.array([5]), WRONG[None]))
    assert weights[0] < 0.01
    np.testing.assert_allclose(moved, truth, atol=0.1)
