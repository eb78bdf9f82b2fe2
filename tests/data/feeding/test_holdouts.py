"""Evaluation sequences are recognised however a reader nests their names."""

import pytest

from logvggt_jax.data.feeding.holdouts import PUBLISHED, HoldOut, check_disjoint, check_held_out


class Named:
    """A data set of which nothing but names is asked."""

    def __init__(self, count: int) -> None:
        self.sequences = [f"s{i}" for i in range(count)]


def no_split(split: str) -> list[str]:
    raise AssertionError(f"split {split} was opened")


def test_scannet_holds_out_the_hundred_scenes_of_its_test_list():
    rule = PUBLISHED["scannet"]
    held = [f"scene{n:04d}_{m:02d}" for n in range(807) for m in range(3) if rule.matches(f"scene{n:04d}_{m:02d}")]
    assert held[0] == "scene0707_00" and held[-1] == "scene0806_00" and len(held) == 100
    check_held_out("scannet", ["scene0000_00", "scene0706_00", "scene0000_01/color_90"], rule, no_split)
    with pytest.raises(ValueError, match=r"scannet: 1 of 2 training .*\(scene0707_00/color_90\).*data\.hold_out"):
        check_held_out("scannet", ["scene0000_00", "scene0707_00/color_90"], rule, no_split)


def test_virtual_kitti_holds_out_one_scene_with_all_its_variations():
    rule = PUBLISHED["virtual_kitti"]
    check_held_out("virtual_kitti", ["Scene01/clone/Camera_0", "Scene02/fog/Camera_1"], rule, no_split)
    with pytest.raises(ValueError, match=r"Scene20/clone/Camera_0, Scene20/fog/Camera_1\)"):
        check_held_out("virtual_kitti", ["Scene20/clone/Camera_0", "Scene20/fog/Camera_1"], rule, no_split)


def test_co3d_holds_out_its_test_split():
    splits = {"test": ["apple/2", "apple/3"]}
    check_held_out("co3dv2", ["apple/1"], PUBLISHED["co3dv2"], splits.__getitem__)
    with pytest.raises(ValueError, match=r"co3dv2: 1 of 2 training sequences .* \(apple/3\)"):
        check_held_out("co3dv2", ["apple/1", "apple/3"], PUBLISHED["co3dv2"], splits.__getitem__)


def test_patterns_have_wildcards_and_match_whole_parts():
    rule = HoldOut(names=("office*", "room_?"))
    assert [name for name in ("office0", "a/office1/b", "my_office", "room_1", "room_10") if rule.matches(name)] == [
        "office0",
        "a/office1/b",
        "room_1",
    ]


def test_long_lists_are_cut_short():
    with pytest.raises(ValueError, match=r"s0, s1, .*s9 and 20 more"):
        check_disjoint("set", Named(40), Named(30))


def test_a_rule_that_holds_nothing_out_is_refused():
    with pytest.raises(ValueError, match="names or a split"):
        HoldOut()
