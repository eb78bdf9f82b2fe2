"""The paper's benchmarks: frames, sizes and settings as its paragraphs and the peers' code say."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from logvggt_jax.data import DATASETS
from logvggt_jax.evaluation.protocols import (
    PointsMeasure,
    Protocol,
    ProtocolSettings,
    chosen_protocols,
    paper_protocols,
)
from logvggt_jax.evaluation.protocols.frame_selection import Clips, Leading, RandomFrames, Spread
from logvggt_jax.evaluation.protocols.images import WholePicture

PROTOCOLS = {protocol.name: protocol for protocol in paper_protocols(ProtocolSettings())}


def frames(name: str, count: int, sequence: str = "any") -> tuple[int, ...]:
    (indices,) = PROTOCOLS[name].frames(sequence, count)
    return indices


def test_names_are_unique_and_data_sets_known() -> None:
    protocols = paper_protocols(ProtocolSettings())
    assert len(PROTOCOLS) == len(protocols)
    assert {protocol.dataset for protocol in protocols} <= set(DATASETS)
    assert all(json.dumps(protocol.describe()) for protocol in protocols)


@pytest.mark.parametrize(("wanted", "stride"), [(200, 5), (500, 2), (1000, 1)])
@pytest.mark.parametrize("dataset", ["seven_scenes", "nrgbd"])
def test_reconstruction_takes_a_thousand_frames_at_strides_5_2_and_1(dataset: str, wanted: int, stride: int) -> None:
    assert frames(f"{dataset}-reconstruction-{wanted}", 1000) == tuple(range(0, 1000, stride))
    # The stairs of 7-Scenes have 500 frames.
    assert len(frames(f"{dataset}-reconstruction-{wanted}", 500)) == min(wanted, 500)


def test_reconstruction_compares_the_middle_224_pixels_of_518_and_scales_it() -> None:
    assert PROTOCOLS["seven_scenes-reconstruction-200"].points == PointsMeasure(224, 1_000_000, 0.1, 0)
    assert PROTOCOLS["seven_scenes-reconstruction-200"].images.size((480, 640)) == (392, 518)
    small = ProtocolSettings(longer_edge=70)
    assert small.points.crop == 30
    assert chosen_protocols(small, ["nrgbd-figures"])[0].images.size((480, 640)) == (56, 70)


def test_figures_take_every_second_frame_and_the_first_hundred() -> None:
    assert frames("seven_scenes-figures", 1000) == tuple(range(0, 1000, 2))
    assert frames("nrgbd-figures", 1700) == tuple(range(100))


def test_video_depth_has_the_peers_frames_masks_and_sequences() -> None:
    assert frames("sintel-depth", 50) == tuple(range(50))
    sintel = PROTOCOLS["sintel-depth"].depth
    assert (sintel.max_depth, sintel.clip) == (70.0, 70.0)
    assert frames("bonn-depth-110", 600) == tuple(range(30, 140))
    assert frames("bonn-depth-500", 400) == tuple(range(30, 400))
    assert (PROTOCOLS["bonn-depth-110"].depth.max_depth, PROTOCOLS["bonn-depth-110"].depth.clip) == (70.0, None)
    assert PROTOCOLS["bonn-depth-110"].takes("rgbd_bonn_crowd2")
    assert not PROTOCOLS["bonn-depth-110"].takes("rgbd_bonn_crowd")
    assert frames("kitti-depth-110", 300) == tuple(range(110))
    assert PROTOCOLS["kitti-depth-110"].depth.max_depth is None
    assert PROTOCOLS["kitti-depth-110"].splits == ("val",)


@pytest.mark.parametrize("name", ["scannet-poses-500", "scannet-ate-50"])
def test_scannet_is_evaluated_on_its_test_scenes_alone(name: str) -> None:
    # A copy without split lists has the scenes of training as well.
    assert all(PROTOCOLS[name].takes(scene) for scene in ("scene0707_00", "scene0806_00", "scene0710_00/color_90"))
    assert not any(PROTOCOLS[name].takes(scene) for scene in ("scene0000_00", "scene0706_00", "scene0000_00/color_90"))


def test_a_sequence_belongs_to_a_benchmark_whatever_is_in_its_name() -> None:
    assert PROTOCOLS["nrgbd-reconstruction-10"].takes("two\nlines")


def test_prepared_sequences_are_not_cut_twice() -> None:
    assert frames("bonn-depth-110", 110, "rgbd_bonn_crowd2/rgb_110") == tuple(range(110))
    assert frames("scannet-ate-50", 90, "scene0707_00/color_90") == tuple(range(50))
    assert frames("scannet-ate-50", 300, "scene0707_00") == tuple(range(0, 150, 3))


def test_tum_dynamics_is_eight_sequences() -> None:
    parts = [f"rgbd_dataset_freiburg3_{a}_{b}" for a in ("sitting", "walking") for b in ("static", "xyz", "rpy")]
    assert all(PROTOCOLS["tum-poses-500"].takes(name) for name in parts)
    assert not PROTOCOLS["tum-poses-500"].takes("rgbd_dataset_freiburg1_xyz")
    assert not PROTOCOLS["tum-poses-500"].takes("rgbd_dataset_freiburg3_sitting_static_validation")


def test_pose_benchmarks_pool_only_categories() -> None:
    assert [name for name, protocol in PROTOCOLS.items() if protocol.pooled] == [
        f"co3dv2-poses-{count}" for count in (10, 200, 500)
    ]


@given(count=st.integers(1, 3000), wanted=st.integers(1, 1000))
def test_selections_are_in_time_order_in_range_and_of_the_size_asked_for(count: int, wanted: int) -> None:
    for selection in (Spread(wanted), RandomFrames(wanted, seed=3), Leading(wanted, stride=2)):
        (indices,) = selection("scene", count)
        assert list(indices) == sorted(set(indices)) and 0 <= indices[0] <= indices[-1] < count
        expected = min(wanted, -(-count // 2) if isinstance(selection, Leading) else count)
        assert len(indices) == expected


def test_random_frames_depend_on_seed_and_name_alone() -> None:
    draw = RandomFrames(50, seed=0)
    assert draw("a", 200) == draw("a", 200) and draw("a", 200) != draw("b", 200)
    assert draw("a", 200) != RandomFrames(50, seed=1)("a", 200)
    covered = np.concatenate([RandomFrames(50, seed=s)("a", 200)[0] for s in range(40)])
    assert len(np.unique(covered)) > 195


def test_a_sequence_without_frames_is_named() -> None:
    for selection in (Spread(3), RandomFrames(3), Leading(3), Clips(3)):
        with pytest.raises(ValueError, match=r"has (no|0) frames"):
            selection("empty", 0)
    with pytest.raises(ValueError, match="has 20 frames, the first that counts is number 30"):
        frames("bonn-depth-110", 20)


def test_patterns_choose_benchmarks_and_unknown_ones_are_named() -> None:
    chosen = chosen_protocols(ProtocolSettings(), ["*-depth-110", "sintel-*"])
    assert [protocol.name for protocol in chosen] == ["sintel-depth", "bonn-depth-110", "kitti-depth-110"]
    with pytest.raises(ValueError, match=r"no benchmark is named 'sintell'; there are seven_scenes-reconstruction-10"):
        chosen_protocols(ProtocolSettings(), ["sintell"])


def test_a_protocol_that_cannot_be_measured_is_refused() -> None:
    depth = PROTOCOLS["sintel-depth"]
    with pytest.raises(ValueError, match="points need images on whose pixels"):
        dataclasses.replace(depth, points=PointsMeasure())
    with pytest.raises(ValueError, match="nothing is measured"):
        Protocol("n", "t", "sintel", ("all",), Leading(None), WholePicture())
