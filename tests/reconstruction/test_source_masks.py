"""Masks given with a sequence: which file is whose, what is refused, and that what they hide is nowhere in a result."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image
from recorder import Recorder, reconstruct_recorded

from logvggt_jax import LogVGGT, ModelConfig
from logvggt_jax.errors import InputError, MissingInput, OutputExists
from logvggt_jax.model.dinov2 import IMAGE_MEAN
from logvggt_jax.reconstruction import PointFilter, Reconstruction, open_source, reconstruct
from logvggt_jax.reconstruction.exporters.colmap import export_colmap
from logvggt_jax.reconstruction.exporters.original_depth import original_depth
from logvggt_jax.reconstruction.exporters.tracks import find_tracks
from logvggt_jax.reconstruction.masking import FILL, mask_at
from logvggt_jax.streaming import METHODS

COUNT, SIZE, LONGER_EDGE = 5, (56, 84), 42


def pictures(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (COUNT, *SIZE, 3), np.uint8)


@pytest.fixture(scope="module")
def kept() -> np.ndarray:
    """Something that moves, and at the lower border something that does not."""
    kept = np.ones((COUNT, *SIZE), bool)
    kept[:, 40:] = False
    for index in range(COUNT):
        kept[index, 5:25, 9 * index : 9 * index + 20] = False
    return kept


def write(folder: Path, images: np.ndarray, suffix: str = ".png") -> Path:
    folder.mkdir(parents=True)
    for index, image in enumerate(images):
        Image.fromarray(image).save(folder / f"{index:03d}{suffix}")
    return folder


@pytest.fixture
def walk(tmp_path: Path) -> Path:
    return write(tmp_path / "walk", pictures(0))


@pytest.fixture
def masks(tmp_path: Path, kept: np.ndarray) -> Path:
    return write(tmp_path / "masks", kept.astype(np.uint8) * 255)


def read_masks(source: Path, masks: Path, **options: object) -> list[np.ndarray]:
    return [frame.mask for frame in open_source(source, masks=masks, **options)]


# Which mask is whose, and what it says.


@pytest.mark.parametrize("suffix", [".png", ".png.png"])
def test_masks_are_named_as_frames_or_their_files(walk: Path, kept: np.ndarray, tmp_path: Path, suffix: str) -> None:
    masks = write(tmp_path / "masks", kept.astype(np.uint8), suffix)  # 1 is not black either
    np.testing.assert_array_equal(read_masks(walk, masks), kept)
    np.testing.assert_array_equal(read_masks(walk, masks, stride=2), kept[::2])


def test_one_mask_serves_all_frames_and_the_note_says_how_much(walk: Path, masks: Path, kept: np.ndarray) -> None:
    np.testing.assert_array_equal(read_masks(walk, masks / "001.png"), kept[[1] * COUNT])
    note = open_source(walk, masks=masks / "001.png").notes[-1]
    assert note == f"{1 - kept[1].mean():.0%} of the pixels are masked, black in {masks / '001.png'}"
    assert "5 masks were looked at" in open_source(walk, masks=masks).notes[-1]


@pytest.mark.parametrize("kind", ["grey", "palette", "transparent", "16 bits", "jpeg"])
def test_black_and_transparent_is_masked_in_every_format(
    walk: Path, kept: np.ndarray, tmp_path: Path, kind: str
) -> None:
    one, path = kept[0], tmp_path / ("mask.jpg" if kind == "jpeg" else "mask.png")
    picture = Image.fromarray(one.astype(np.uint8) * 255)
    if kind == "palette":
        picture = Image.fromarray(one.astype(np.uint8))
        picture.putpalette([0, 0, 0, 0, 0, 200])
    elif kind == "transparent":
        picture = Image.fromarray(np.dstack([pictures(0)[0] | 1, one * 255]).astype(np.uint8), "RGBA")
    elif kind == "16 bits":
        picture = Image.fromarray(one.astype(np.uint16) * 3)
    picture.save(path)
    found = read_masks(walk, path)[0]
    assert (found == one).mean() > (0.97 if kind == "jpeg" else 0.999999)


def test_masks_turn_with_their_pictures(tmp_path: Path, kept: np.ndarray) -> None:
    """A phone's picture lies sideways in its file; masks are of the pixels there, or of the upright picture."""
    folder = tmp_path / "phone"
    folder.mkdir()
    exif = Image.Exif()
    exif[0x0112] = 6
    Image.fromarray(pictures(0)[0]).save(folder / "a.jpg", exif=exif)
    upright = np.rot90(kept[0], -1)
    for name, mask in {"stored": kept[0], "upright": upright}.items():
        file = tmp_path / f"{name}.png"
        Image.fromarray(mask.astype(np.uint8) * 255).save(file)
        np.testing.assert_array_equal(read_masks(folder, file)[0], upright)


def test_masks_are_cut_with_their_pictures(walk: Path, masks: Path, kept: np.ndarray) -> None:
    for folder in (walk, masks):
        picture = np.asarray(Image.open(folder / "002.png"))
        Image.fromarray(picture[8:48]).save(folder / "002.png")
    found = read_masks(walk, masks, size_mismatch="crop")
    np.testing.assert_array_equal(found[0], kept[0, 8:48])
    np.testing.assert_array_equal(found[2], kept[2, 8:48])


def test_masks_of_a_video_are_named_after_positions(tmp_path: Path, kept: np.ndarray) -> None:
    video = tmp_path / "walk.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, SIZE[::-1])
    for picture in pictures(0):
        writer.write(picture)
    writer.release()
    masks = write(tmp_path / "masks", kept.astype(np.uint8) * 255)
    np.testing.assert_array_equal(read_masks(video, masks, stride=2), kept[::2])
    (masks / "000.png").rename(masks / "frame-000005.png")
    with pytest.raises(MissingInput, match=r"no mask in .* for frame-000000: .*counted from 0"):
        open_source(video, masks=masks)


# What is refused, in one line.


DAMAGES = {
    "no folder": (shutil.rmtree, r"masks does not exist: expected a folder of masks"),
    "empty": (lambda masks: [file.unlink() for file in masks.iterdir()], r"no mask in .*masks: expected a picture"),
    "other names": (
        lambda masks: [file.rename(masks / f"m{file.name}") for file in list(masks.iterdir())],
        r"no mask in .* is named after a frame: expected 000\.png or 000\.png\.png, found m000\.png",
    ),
    "one missing": (lambda masks: (masks / "003.png").unlink(), r"for 1 of 5 frames \(003\.png\): expected 003\.png"),
    "another size": (
        lambda masks: Image.new("L", (80, 56), 255).save(masks / "003.png"),
        r"003\.png is 80 x 56 pixels, its frame 84 x 56: a mask needs the size of its frame",
    ),
    "no picture": (lambda masks: (masks / "003.png").write_text("hello there"), r"003\.png is no picture"),
    "cut off": (
        lambda masks: os.truncate(masks / "003.png", (masks / "003.png").stat().st_size // 2),
        r"003\.png: truncated",
    ),
    "two of one": (
        lambda masks: shutil.copy(masks / "003.png", masks / "003.bmp"),
        r"003\.bmp and 003\.png are masks of one frame",
    ),
    "everything": (
        lambda masks: [Image.new("L", SIZE[::-1], 0).save(file) for file in masks.iterdir()],
        r"masks: everything is masked; black is what is left out, are they inverted\?",
    ),
    "the first whole": (
        lambda masks: Image.new("L", SIZE[::-1], 0).save(masks / "000.png"),
        r"000\.png: the first frame is masked whole",
    ),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_masks_that_cannot_be_used_are_named(walk: Path, masks: Path, damage: str) -> None:
    act, message = DAMAGES[damage]
    act(masks)
    with pytest.raises(InputError, match=message) as caught:
        open_source(walk, masks=masks)
    assert "\n" not in str(caught.value)


def test_the_images_are_no_masks_of_themselves(walk: Path) -> None:
    with pytest.raises(InputError, match="holds the images themselves"):
        open_source(walk, masks=walk)


def test_a_camera_takes_one_mask_for_all_frames(masks: Path) -> None:
    with pytest.raises(InputError, match="masks is a folder: a camera or a stream takes one mask"):
        open_source("rtsp://127.0.0.1:1/nothing", masks=masks)


def test_masks_of_nearly_everything_are_doubted(walk: Path, tmp_path: Path) -> None:
    mask = np.zeros(SIZE, np.uint8)
    mask[:10] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    assert open_source(walk, masks=tmp_path / "mask.png").notes[-1].endswith("are they inverted?")


def test_methods_without_masks_refuse_them_before_they_begin(walk: Path, masks: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--method recorder takes no masks: choose one of windows, offline, chunks"):
        reconstruct_recorded(Recorder(), open_source(walk, masks=masks), tmp_path / "out", progress=False)
    assert not list(tmp_path.glob("out*"))


# What becomes of them.


def test_a_pixel_counts_if_all_under_it_does() -> None:
    mask = np.ones((8, 12), bool)
    mask[3, 5] = False
    np.testing.assert_array_equal(np.argwhere(~mask_at(mask, (4, 6))), [[1, 2]])
    np.testing.assert_array_equal(mask_at(mask, (16, 24)).reshape(8, 2, 12, 2).all((1, 3)), mask)
    np.testing.assert_allclose(FILL / 255, IMAGE_MEAN, atol=2e-3)


def everything_written(folder: Path) -> dict[str, bytes]:
    """All files but for the source's own facts."""
    files = {str(file.relative_to(folder)): file.read_bytes() for file in folder.rglob("*") if file.is_file()}
    cameras = files.pop("cameras.json").decode()
    return {**files, "cameras": cameras[: cameras.index('"source"')] + cameras[cameras.index('"skipped"') :]}


@pytest.mark.filterwarnings("ignore:.*no field of view")
@pytest.mark.parametrize("method", ["windows", "chunks"])
def test_what_is_masked_is_nowhere_in_a_result(
    method: str, small_config: ModelConfig, small_variables: dict, masks: Path, kept: np.ndarray, tmp_path: Path
) -> None:
    """Two sequences that differ under their masks alone give the same bytes: cameras, depth, images, previews, health,
    points."""
    results = []
    for name, seed in {"one": 0, "other": 1}.items():
        images = np.where(kept[..., None], pictures(0), pictures(seed))
        source = open_source(write(tmp_path / name / "walk", images), masks=masks)
        results.append(
            reconstruct(
                source,
                tmp_path / f"{name}-out",
                model=LogVGGT(small_config),
                variables=small_variables,
                method=method,
                settings=METHODS["chunks"].settings(3, 1) if method == "chunks" else None,
                longer_edge=LONGER_EDGE,
                point_filter=PointFilter(confidence_percentile=0, edge_threshold=None, max_points=None),
                num_previews=1,
                progress=False,
            )
        )
    first, second = (everything_written(result.folder) for result in results)
    assert first.keys() == second.keys()
    assert [name for name in first if first[name] != second[name]] == []
    check_result(results[0], kept)
    if method == "windows":
        check_colmap(results[0], tmp_path / "colmap")


def check_result(result: Reconstruction, kept: np.ndarray) -> None:
    small = np.stack([mask_at(mask, result.depth_size) for mask in kept])
    for index in range(COUNT):
        depth, confidence = result.depth_and_confidence(index)
        np.testing.assert_array_equal(confidence > 0, small[index])
        assert not depth[~small[index]].any()
        original = original_depth(result, index) > 0
        assert not (original & (mask_at(small[index], SIZE) == 0)).any(), "exports have no depth there either"
    np.testing.assert_allclose(result.masked, 1 - small.mean((1, 2)), atol=1e-4)
    assert result.num_points <= small.sum()
    assert f"masked: {result.masked.mean():.0%} of the pixels" in result.summary()
    tracks = find_tracks(result, None, progress=False)
    u, v = np.rint(tracks.pixels).astype(int).T
    assert small[tracks.frames, v, u].all(), "no observation of a point lies under a mask"


def check_colmap(result: Reconstruction, folder: Path) -> None:
    pytest.importorskip("pycolmap", reason='needs pycolmap: pip install "logvggt-jax[colmap]"')
    folder.mkdir()
    export_colmap(result, folder, progress=False)
    for index, image in enumerate(sorted((folder / "images").iterdir())):
        with Image.open(folder / "masks" / f"{image.name}.png") as picture:
            black = np.asarray(picture) == 0
        np.testing.assert_array_equal(black, original_depth(result, index) == 0)


def test_a_run_is_taken_up_with_its_own_masks_alone(walk: Path, masks: Path, tmp_path: Path) -> None:
    def die(count: int) -> None:
        if count == 4:
            raise KeyboardInterrupt

    class Masking(Recorder):
        def push(self, frame: np.ndarray, mask: np.ndarray) -> list:
            assert mask.shape == frame.shape[:2]
            return super().push(frame)

    def run(predictor: Recorder, masks: Path | None) -> Reconstruction:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("logvggt_jax.reconstruction.run._SAVING", 1e9)
            source = open_source(walk, masks=masks)
            options = {"takes_masks": True, "progress": False, "save_seconds": 0.0}
            return reconstruct_recorded(predictor, source, tmp_path / "out", **options)

    with pytest.raises(KeyboardInterrupt):
        run(Masking(die), masks)
    with pytest.raises(OutputExists, match="differs in masks"):
        run(Recorder(), None)
    changed = masks / "001.png"
    stamp = changed.stat().st_mtime_ns
    os.utime(changed, ns=(stamp + 10**9, stamp + 10**9))
    with pytest.raises(InputError, match="the masks of frames that were read have changed"):
        run(Masking(), masks)
    os.utime(changed, ns=(stamp, stamp))
    last = Masking()
    assert run(last, masks).masked.all()
    assert last.num_pushed == COUNT - 3
