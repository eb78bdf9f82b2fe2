"""Point-cloud metrics against stored values of the public reference pipeline."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from logvggt_jax.geometry import quaternion_to_matrix, umeyama
from logvggt_jax.metrics import point_cloud_metrics
from logvggt_jax.metrics.errors import NotMeasurable
from logvggt_jax.metrics.points import estimate_normals, register_icp, sample_indices

FAMILY = "points"
KEYS = {
    "acc_mean": "acc_mean",
    "acc_median": "acc_med",
    "comp_mean": "comp_mean",
    "comp_median": "comp_med",
    "nc_mean": "nc_mean",
    "nc_median": "nc_med",
    "chamfer_sum": "derived_chamfer_sum",
    "chamfer_mean": "derived_chamfer_half_sum",
}
GIVEN_NORMALS = ("sphere_given_normals", "box_given_normals", "plane_given_normals", "half_coverage", "identical")
# `far_offset_icp` is informational: an ICP that does not converge depends on its implementation.
ICP = ("box_icp", "sphere_icp", "two_planes_icp", "fewer_than_knn")


def assert_icp_metrics(actual: dict[str, float], case: dict[str, Any]) -> None:
    tolerance = case["tol"]
    for ours, theirs in KEYS.items():
        bound = {"abs": tolerance["nc_abs"]} if ours.startswith("nc") else {"rel": tolerance["acc_comp_rel"]}
        assert actual[ours] == pytest.approx(case["expected"][theirs], **bound), ours


@pytest.mark.parametrize("name", GIVEN_NORMALS)
def test_metrics_with_given_normals_equal_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    case = cases[name]
    actual = point_cloud_metrics(
        arrays[f"{name}/pred"],
        arrays[f"{name}/gt"],
        prediction_normals=arrays[f"{name}/pred_normals"],
        target_normals=arrays[f"{name}/gt_normals"],
        icp_threshold=None,
    )
    for ours, theirs in KEYS.items():
        tolerance = {"rel": case.get("tol_rel", 0), "abs": case.get("tol_abs", 0)}
        assert actual[ours] == pytest.approx(case["expected"][theirs], **tolerance), ours


@pytest.mark.parametrize("name", ICP)
def test_registration_normals_and_metrics_equal_the_reference(golden: tuple[dict[str, Any], Any], name: str) -> None:
    cases, arrays = golden
    case = cases[name]
    prediction, target = arrays[f"{name}/pred"], arrays[f"{name}/gt"]
    motion = register_icp(prediction, target, 0.1)
    np.testing.assert_allclose(motion, arrays[f"{name}/icp_T"], atol=case["tol"]["icp_T_abs"])
    moved = prediction @ motion[:3, :3].T + motion[:3, 3]
    for points, key in ((moved, "pred_normals"), (target, "gt_normals")):
        cosine = np.abs((estimate_normals(points) * arrays[f"{name}/{key}"]).sum(-1))
        assert (cosine > 0.999).mean() >= 0.99
    assert_icp_metrics(point_cloud_metrics(prediction, target), case)


def test_similarity_protocol_equals_the_reference(golden: tuple[dict[str, Any], Any]) -> None:
    cases, arrays = golden
    case = cases["umeyama_protocol"]
    source, target = arrays["umeyama_protocol/src"], arrays["umeyama_protocol/dst"]
    similarity = umeyama(source, target)
    tolerance = case["tol"]["srt_abs"]
    assert similarity.scale == pytest.approx(float(arrays["umeyama_protocol/s"]), abs=tolerance)
    np.testing.assert_allclose(similarity.rotation, arrays["umeyama_protocol/R"], atol=tolerance)
    np.testing.assert_allclose(similarity.translation, arrays["umeyama_protocol/t"], atol=tolerance)
    assert_icp_metrics(point_cloud_metrics(similarity.apply(source), target), case)


def sphere(rng: np.random.Generator, count: int) -> np.ndarray:
    points = rng.normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True)


@given(seed=st.integers(0, 10_000), counts=st.tuples(st.integers(1, 60), st.integers(1, 60)))
@settings(deadline=None, max_examples=40)
def test_accuracy_and_completeness_swap_with_the_clouds(seed: int, counts: tuple[int, int]) -> None:
    rng = np.random.default_rng(seed)
    a, b = sphere(rng, counts[0]), 1.1 * sphere(rng, counts[1])
    normals_a, normals_b = a, b / 1.1
    forth = point_cloud_metrics(a, b, prediction_normals=normals_a, target_normals=normals_b, icp_threshold=None)
    back = point_cloud_metrics(b, a, prediction_normals=normals_b, target_normals=normals_a, icp_threshold=None)
    for kind in ("mean", "median"):
        assert forth[f"acc_{kind}"] == back[f"comp_{kind}"]
        assert forth[f"comp_{kind}"] == back[f"acc_{kind}"]
        assert forth[f"nc_{kind}"] == pytest.approx(back[f"nc_{kind}"])
    assert forth["chamfer_sum"] == pytest.approx(2 * forth["chamfer_mean"])


@given(seed=st.integers(0, 10_000), scale=st.floats(0.05, 20.0))
@settings(deadline=None, max_examples=20)
def test_a_similarity_of_the_prediction_changes_nothing_after_alignment(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    target = rng.uniform(-1, 1, (80, 3))
    prediction = target + rng.normal(0, 0.05, (80, 3))
    normals = sphere(rng, 80)
    rotation = quaternion_to_matrix(rng.normal(size=4))
    moved = scale * prediction @ rotation.T + rng.normal(size=3)
    base, other = (
        point_cloud_metrics(
            umeyama(points, target).apply(points),
            target,
            prediction_normals=normals,
            target_normals=normals,
            icp_threshold=None,
        )
        for points in (prediction, moved)
    )
    assert other == pytest.approx(base, rel=1e-6)


def test_icp_turns_given_normals_with_the_points() -> None:
    rng = np.random.default_rng(3)
    target = rng.uniform(-1, 1, (400, 3)) * [1.0, 0.6, 0.3]
    normals = sphere(rng, 400)
    angle = 0.03
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    metrics = point_cloud_metrics(target @ turn.T, target, prediction_normals=normals @ turn.T, target_normals=normals)
    assert metrics["acc_mean"] < 1e-6 and metrics["nc_mean"] == pytest.approx(1.0, abs=1e-6)


def test_sampling_keeps_correspondence_and_repeats_with_its_seed() -> None:
    indices = sample_indices(1000, 100, seed=7)
    np.testing.assert_array_equal(indices, sample_indices(1000, 100, seed=7))
    assert len(np.unique(indices)) == 100 and (np.diff(indices) > 0).all()
    assert not np.array_equal(indices, sample_indices(1000, 100, seed=8))
    np.testing.assert_array_equal(sample_indices(50, 100, seed=7), np.arange(50))
    np.testing.assert_array_equal(sample_indices(50, None, seed=7), np.arange(50))


@pytest.mark.parametrize(
    ("prediction", "message", "kind"),
    [
        (np.zeros((0, 3)), "prediction has no points", NotMeasurable),
        (np.zeros((4, 2)), "prediction must be a cloud", ValueError),
        (np.array([[0.0, 0, 0], [np.nan, 0, 0]]), "prediction: point 1 is not finite", NotMeasurable),
    ],
)
def test_bad_clouds_are_named(prediction: np.ndarray, message: str, kind: type[ValueError]) -> None:
    with pytest.raises(kind, match=message):
        point_cloud_metrics(prediction, np.zeros((4, 3)))


def test_normals_need_the_shape_of_their_points() -> None:
    with pytest.raises(ValueError, match="target_normals must have the shape"):
        point_cloud_metrics(np.zeros((4, 3)), np.zeros((4, 3)), target_normals=np.zeros((3, 3)))


@pytest.mark.parametrize("threshold", [0, -0.1, np.nan])
def test_a_threshold_that_no_distance_is_below_is_refused(threshold: float) -> None:
    """Open3D's own error is a RuntimeError of several lines; for NaN there is none, and no ICP either."""
    with pytest.raises(ValueError, match="icp_threshold must be a distance above 0"):
        point_cloud_metrics(np.eye(3), np.eye(3), icp_threshold=threshold)
