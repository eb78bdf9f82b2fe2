"""Data sets as evaluation opens them: rooms at the model's size, everything else from disk, missing ones named."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.registry import open_dataset
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.baselines import all_baselines, static_camera, unit_depth
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.protocols import Protocol, ProtocolSettings, chosen_protocols
from logvggt_jax.evaluation.protocols.clips import clip_protocols
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.evaluation.runner import Benchmark
from logvggt_jax.evaluation.settings import ClipRun, PaperRun
from logvggt_jax.model.logvggt import LogVGGT


def open_run(
    run: ClipRun | PaperRun, data_root: str | Path | None
) -> tuple[list[Benchmark], Callable[[LogVGGT], list[Method]]]:
    """The benchmarks of a run, and what makes its baselines once the model is known (nothing where it wants none).

    Raises as `open_benchmarks` and `open_evaluation_set`.
    """
    if isinstance(run, PaperRun):
        protocols = chosen_protocols(run.protocol, run.benchmarks)
        benchmarks = open_benchmarks(protocols, data_root, run.protocol)
        return benchmarks, lambda _: [unit_depth(), static_camera()] if run.baselines else []
    clips = run.evaluation
    dataset, known_set, known = open_evaluation_set(
        run.dataset,
        None if data_root is None else str(data_root),
        split=run.split,
        image_size=clips.image_size,
        rooms=run.rooms,
    )
    benchmarks = [Benchmark(each, dataset, run.split) for each in clip_protocols(run.dataset, run.split, clips)]

    def baselines(model: LogVGGT) -> list[Method]:
        return all_baselines(model, known_set, clips.image_size, source=known, seed=clips.seed) if run.baselines else []

    return benchmarks, baselines


def open_evaluation_set(
    name: str, root: str | None, *, split: str, image_size: tuple[int, int], rooms: Mapping[str, Any] | None = None
) -> tuple[Dataset, Dataset, str]:
    """The data set to evaluate, and the one whose mean depth the baselines know, with its name for the table.

    Rooms, whose `root` is None and whose further options are `rooms`, are rendered at `image_size` (H, W), as they are
    for training, and paired with their training split. Any other set has to lend its own mean, and the name says so.
    Raises InputError where `root` is missing, does not hold the data set, or is given for rooms, and for an unknown
    option of rooms.
    """
    if name != "rooms":
        if root is None:
            raise InputError(f"data set {name!r} is read from disk: give its folder with --data_root")
        dataset = open_dataset(name, root, split)
        return dataset, dataset, "frames of the evaluated set itself (knows the test set's mean)"
    if root is not None:
        raise InputError(f"rooms are rendered, not read: leave --data_root={root} out")
    options = dict(rooms or {})
    train = {key: value for key, value in options.items() if key != "num_rooms"}
    return _rooms(split, image_size, options), _rooms("train", image_size, train), "training rooms"


def open_benchmarks(
    protocols: Sequence[Protocol], data_root: str | Path | None, settings: ProtocolSettings
) -> list[Benchmark]:
    """Each protocol with its data, from the folder `data_root`/<data set's name>, or with the reason why it has none.

    Of the settings `longer_edge` and `rooms` are used, for rooms, which are rendered. Raises InputError where
    `data_root` is not a folder, or has none of the data sets that were asked for, and for an unknown option of rooms.
    """
    root = None if data_root is None else Path(data_root)
    if root is not None and not root.is_dir():
        raise InputError(f"{root}: no such folder; --data_root is the folder that holds one folder a data set")
    opened: dict[tuple[str, tuple[str, ...]], tuple[Dataset | None, str, str]] = {}
    for protocol in protocols:
        key = (protocol.dataset, protocol.splits)
        if key in opened:
            continue
        if protocol.dataset == "rooms":
            size = PrincipalPointCrop(settings.longer_edge).size((3, 4))
            opened[key] = _rooms(protocol.splits[0], size, settings.rooms), protocol.splits[0], ""
        elif root is None:
            opened[key] = None, "", f"{protocol.dataset}: no --data_root was given"
        else:
            opened[key] = _first_split(protocol, root / protocol.dataset)
    benchmarks = [Benchmark(protocol, *opened[protocol.dataset, protocol.splits]) for protocol in protocols]
    on_disk = sorted({protocol.dataset for protocol in protocols} - {"rooms"})
    found = any(benchmark.dataset is not None for benchmark in benchmarks if benchmark.protocol.dataset != "rooms")
    if root is not None and on_disk and not found:
        reasons = "; ".join(dict.fromkeys(benchmark.missing for benchmark in benchmarks if benchmark.missing))
        raise InputError(f"{root}: holds none of the data sets {', '.join(on_disk)} ({reasons})")
    return benchmarks


def _first_split(protocol: Protocol, folder: Path) -> tuple[Dataset | None, str, str]:
    """The first of the protocol's splits that the folder has, its name; or why there is none."""
    if not folder.is_dir():
        return None, "", f"{folder}: no such folder"
    reasons: list[str] = []
    for split in protocol.splits:
        try:
            return open_dataset(protocol.dataset, folder, split), split, ""
        except (InputError, OSError, ImportError) as error:
            reasons.append(f"{protocol.dataset}, split {split}: {error}")
    return None, "", "; ".join(reasons)


def _rooms(split: str, image_size: tuple[int, int], options: Mapping[str, Any]) -> Dataset:
    """Rooms rendered at (H, W)."""
    for name in ("split", "height", "width"):
        if name in options:
            raise InputError(f"rooms: {name} follows from the run's split and image size, leave it out")
    return open_dataset("rooms", None, split, height=image_size[0], width=image_size[1], **options)
