"""Speed of the training data at 518 pixels beside the floor, and the memory of its workers.

    python benchmarks/data_pipeline.py

Writes a stand-in data set in the layout of 7-Scenes (JPEG colour, 16-bit PNG depth) into a temporary folder. The floor
is a bare loop in as many processes as there are workers: read the files, decode, resize and jitter by the same library
calls, keep nothing. The pipeline adds the checks of files and frames, cameras, clips, batches and the way from worker
to trainer; once more it runs on the same frames in shards (`logvggt data pack`), where nothing is decoded. Floor and
pipelines take turns, so that a busy machine slows all; the processor's time shows the ratio where other programs share
it. The default size of the files is the median of the training sets'.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import statistics
import tempfile
import time
from multiprocessing.synchronize import Barrier
from pathlib import Path

import cv2
import numpy as np
from PIL import Image

from logvggt_jax.data import open_dataset, training_batches
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.packed.pack import pack

SIZE = (392, 518)
SEQUENCES, FRAMES = 4, 24
AUGMENTATION = ColourAugmentation(
    shared=0.7,
    jitter=1.0,
    brightness=0.5,
    contrast=0.5,
    saturation=0.5,
    hue=0.1,
    grey=0.0,
    blur=0.0,
    blur_sigma=(0.1, 1.0),
)
MIB = 2**20


def write_data_set(root: Path, height: int, width: int) -> None:
    """Sequences of pictures whose detail falls with its frequency, as in photographs, and of depth with noise."""
    rng = np.random.default_rng(0)
    frequency = np.hypot(np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)) + 1.0 / width
    for sequence in range(SEQUENCES):
        folder = root / "room" / f"seq-{sequence + 1:02d}"
        folder.mkdir(parents=True)
        channels = [np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) / frequency).real for _ in range(4)]
        picture = np.stack([128 + 50 * channel / channel.std() for channel in channels[:3]], 2).clip(0, 255)
        depth = 2500 + 500 * channels[3] / channels[3].std() + rng.normal(0, 2, (height, width))
        for frame in range(FRAMES):
            name = folder / f"frame-{frame:06d}"
            shifted = np.roll(picture, 4 * frame, axis=1).astype(np.uint8)
            cv2.imwrite(f"{name}.color.jpg", shifted, [cv2.IMWRITE_JPEG_QUALITY, 92])
            cv2.imwrite(f"{name}.depth.proj.png", np.roll(depth, 4 * frame, axis=1).astype(np.uint16))
            pose = np.eye(4)
            pose[0, 3] = 0.01 * frame
            np.savetxt(f"{name}.pose.txt", pose)


def floor(root: Path, clips: int, clip_length: int, start: Barrier, results: multiprocessing.Queue) -> None:
    """A bare loop over `clips` clips; its seconds by the clock and of the processor."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    colours = sorted(root.rglob("*.color.jpg"))
    height, width = SIZE
    start.wait()
    started, used = time.perf_counter(), time.process_time()
    for _ in range(clips):
        for path in rng.choice(colours, clip_length):
            picture = cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_UNCHANGED)
            picture = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            data = path.with_name(path.name.replace("color.jpg", "depth.proj.png")).read_bytes()
            depth = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
            small = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BICUBIC))
            cv2.resize(depth.astype(np.float32), (width, height), interpolation=cv2.INTER_NEAREST)
            affine = np.column_stack([np.eye(3) * rng.uniform(0.5, 1.5), np.full(3, cv2.mean(small)[0])])
            cv2.transform(small, affine)
    results.put((time.perf_counter() - started, time.process_time() - used))


def measure_floor(root: Path, clips: int, clip_length: int, processes: int) -> tuple[float, float]:
    """Of `processes` bare loops at once: clips a second, and processor seconds a clip."""
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(processes), context.Queue()
    loops = [context.Process(target=floor, args=(root, clips, clip_length, start, results)) for _ in range(processes)]
    for loop in loops:
        loop.start()
    times = [results.get() for _ in loops]
    for loop in loops:
        loop.join()
    return sum(clips / seconds for seconds, _ in times), statistics.mean(used for _, used in times) / clips


def measure_pipeline(root: Path, clips: int, clip_length: int, workers: int) -> tuple[float, float, float]:
    """Of `workers` workers: clips a second, processor seconds a clip, the largest peak of a worker's memory in MiB."""
    with training_batches(
        {"stand_in": open_dataset("seven_scenes", root)},
        clip_length=clip_length,
        batch_size=1,
        sizes=[SIZE],
        seed=0,
        stride=(1, 2),
        augmentation=AUGMENTATION,
        max_broken=0.01,
        worker_count=workers,
        num_threads=1,
    ) as batches:
        for _ in range(4 * workers):
            next(batches)
        pids = [child.pid for child in multiprocessing.active_children()]
        started, used = time.perf_counter(), sum(map(processor_time, pids))
        for _ in range(clips * workers):
            next(batches)
        seconds = time.perf_counter() - started
        used = sum(map(processor_time, pids)) - used
        return clips * workers / seconds, used / (clips * workers), max(map(peak_memory, pids))


def processor_time(pid: int | None) -> float:
    """Processor seconds of a process so far; NaN where the system has no /proc."""
    path = Path(f"/proc/{pid}/stat")
    if not path.exists():
        return float("nan")
    # The name in parentheses may hold spaces; user and system time are the 14th and 15th fields.
    user, system = path.read_text().rpartition(")")[2].split()[11:13]
    return (int(user) + int(system)) / os.sysconf("SC_CLK_TCK")


def peak_memory(pid: int | None) -> float:
    """Largest resident memory of a process so far, MiB; NaN where the system has no /proc."""
    path = Path(f"/proc/{pid}/status")
    if not path.exists():
        return float("nan")
    fields = dict(line.split(":", 1) for line in path.read_text().splitlines() if ":" in line)
    return int(fields["VmHWM"].split()[0]) / 1024


def main() -> None:
    """Prints a line on the shards, and five for each number of workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--clips", type=int, default=12, help="clips a worker and round")
    parser.add_argument("--clip-length", type=int, default=12)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--height", type=int, default=768, help="of the files; their width is 4/3 of it")
    options = parser.parse_args()
    width = options.height * 4 // 3
    clip = options.clip_length * SIZE[0] * SIZE[1] * (3 + 4)
    print(
        f"{options.height} x {width} files to {SIZE[0]} x {SIZE[1]}, clips of {options.clip_length}: "
        f"{clip / MIB:.0f} MiB each, of which a worker holds at most four"
    )
    with tempfile.TemporaryDirectory() as folder:
        root, shards = Path(folder) / "files", Path(folder) / "shards"
        write_data_set(root, options.height, width)
        started, files = time.process_time(), sum(path.stat().st_size for path in root.rglob("*.*") if path.is_file())
        packed = pack("seven_scenes", root, shards)
        print(
            f"packed: {packed.bytes / files:.1f} x the bytes of the files, "
            f"{1000 * (time.process_time() - started) / packed.frames:.0f} ms of processor a frame, once"
        )
        for workers in options.workers:
            floors, pipelines, of_shards = [], [], []
            for _ in range(options.rounds):
                floors.append(measure_floor(root, options.clips, options.clip_length, workers))
                pipelines.append(measure_pipeline(root, options.clips, options.clip_length, workers))
                of_shards.append(measure_pipeline(shards, options.clips, options.clip_length, workers))
            for name, rounds in (("floor", floors), ("pipeline", pipelines), ("shards", of_shards)):
                speed, used = statistics.median(each[0] for each in rounds), min(each[1] for each in rounds)
                print(
                    f"{workers} workers, {name:8}: {speed:.2f} clips/s, {speed * options.clip_length:.1f} frames/s, "
                    f"{1000 * used:.0f} ms of processor a clip"
                )
            pairs = list(zip(floors, pipelines, strict=True))
            by_clock = statistics.median(least[0] / ours[0] for least, ours in pairs)
            by_processor = min(ours[1] for ours in pipelines) / min(least[1] for least in floors)
            print(
                f"{workers} workers, pipeline over floor: {by_clock:.2f} by the clock, {by_processor:.2f} of processor"
            )
            by_clock = statistics.median(each[0] / ours[0] for each, ours in zip(of_shards, pipelines, strict=True))
            by_processor = min(ours[1] for ours in pipelines) / min(each[1] for each in of_shards)
            print(f"{workers} workers, shards over files: {by_clock:.2f} by the clock, {by_processor:.2f} of processor")
            print(f"{workers} workers, peak memory of a worker: {max(ours[2] for ours in pipelines):.0f} MiB")


if __name__ == "__main__":
    main()
