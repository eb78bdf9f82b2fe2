"""Data sets as evaluation opens them: from disk, or made at the model's size; missing ones are named."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from logvggt_jax.data.dataset import Reader
from logvggt_jax.data.registry import READERS, checked_options, open_dataset
from logvggt_jax.errors import InputError
from logvggt_jax.evaluation.methods.baselines import all_baselines, static_camera, unit_depth
from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.plan import Benchmark
from logvggt_jax.evaluation.protocols import Protocol, ProtocolSettings, chosen_protocols
from logvggt_jax.evaluation.protocols.clips import clip_protocols
from logvggt_jax.evaluation.protocols.images import PrincipalPointCrop
from logvggt_jax.evaluation.settings import ClipRun, PaperRun
from logvggt_jax.model.logvggt import LogVGGT


def open_run(
    run: ClipRun | PaperRun, data_root: str | Path | None, longer_edge: int | None
) -> tuple[list[Benchmark], Callable[[LogVGGT], list[Method]]]:
    """The benchmarks of a run, and what makes its baselines once the model is known (nothing where it wants none).

    `longer_edge`, of the images that the checkpoint was trained on, is for a run that says no size. Raises as
    `open_benchmarks` and `open_evaluation_set`, and InputError where neither says the size.
    """
    if isinstance(run, PaperRun):
        protocols = chosen_protocols(run.protocol, run.benchmarks)
        benchmarks = open_benchmarks(protocols, data_root, run.protocol)
        return benchmarks, lambda _: [unit_depth(), static_camera()] if run.baselines else []
    clips = run.evaluation
    image_size = clips.image_size
    if image_size is None:
        if longer_edge is None:
            raise InputError(
                "the checkpoint does not say at which image size it was trained; give it as "
                "--config.evaluation.image_size='(H, W)', multiples of 14 pixels"
            )
        image_size = PrincipalPointCrop(longer_edge).size((3, 4))
    root = None if data_root is None else str(data_root)
    dataset = open_evaluation_set(run.dataset, root, split=run.split, image_size=image_size, options=run.options)
    protocols = clip_protocols(run.dataset, run.split, clips, image_size)
    benchmarks = [Benchmark(each, dataset, run.split) for each in protocols]

    def baselines(model: LogVGGT) -> list[Method]:
        if not run.baselines:
            return []
        known = dataset.training_split()
        source = "frames of the evaluated set itself (knows the test set's mean)"
        if known is not None:
            source = f"the training split of {known.title}"
        return all_baselines(model, known or dataset, image_size, source=source, seed=clips.seed)

    return benchmarks, baselines


def open_evaluation_set(
    name: str, root: str | Path | None, *, split: str, image_size: tuple[int, int], options: Mapping[str, Any]
) -> Reader:
    """The data set of one run, in folder `root` if it needs one; a set that is made is made at `image_size` (H, W).

    Raises InputError where `root` is missing, does not hold the data set, or is given for a set that has no folder,
    and for an option that its reader does not have or that the run decides.
    """
    sizes = READERS[name].size_options(image_size) if name in READERS else {}
    for option in ("root", "split", *sizes):
        if option in options:
            raise InputError(f"{name}: {option} follows from the rest of the run, leave it out of the set's options")
    # A configuration that is for another data set is told before its folder is asked for.
    checked_options(name, options)
    reader = READERS[name]
    if root is None and reader.needs_root:
        raise InputError(f"data set {name!r} is read from disk: give its folder with --data_root")
    if root is not None and not reader.needs_root:
        raise InputError(f"{name} are made, not read: leave --data_root={root} out")
    return open_dataset(name, root, split, **sizes, **options)


def open_benchmarks(
    protocols: Sequence[Protocol], data_root: str | Path | None, settings: ProtocolSettings
) -> list[Benchmark]:
    """Each protocol with its data, from the folder `data_root`/<data set's name>, or with the reason why it has none.

    Of the settings `options` are used, and `longer_edge` for sets that are made. Raises InputError where `data_root` is
    not a folder, or has none of the data sets that were asked for, and for an option that no reader has.
    """
    for name, options in settings.options.items():
        checked_options(name, options)
    root = None if data_root is None else Path(data_root)
    if root is not None and not root.is_dir():
        raise InputError(f"{root}: no such folder; --data_root is the folder that holds one folder a data set")
    opened: dict[tuple[str, tuple[str, ...]], tuple[Reader | None, str, str]] = {}
    for protocol in protocols:
        key = (protocol.dataset, protocol.splits)
        if key in opened:
            continue
        if not READERS[protocol.dataset].needs_root:
            opened[key] = _opened(protocol, None, protocol.splits[0], settings), protocol.splits[0], ""
        elif root is None:
            opened[key] = None, "", f"{protocol.dataset}: no --data_root was given"
        else:
            opened[key] = _first_split(protocol, root / protocol.dataset, settings)
    benchmarks = [Benchmark(protocol, *opened[protocol.dataset, protocol.splits]) for protocol in protocols]
    on_disk = sorted({protocol.dataset for protocol in protocols if READERS[protocol.dataset].needs_root})
    found = {benchmark.protocol.dataset for benchmark in benchmarks if benchmark.dataset is not None}
    if root is not None and on_disk and found.isdisjoint(on_disk):
        reasons = "; ".join(dict.fromkeys(benchmark.missing for benchmark in benchmarks if benchmark.missing))
        raise InputError(f"{root}: holds none of the data sets {', '.join(on_disk)} ({reasons})")
    return benchmarks


def _first_split(protocol: Protocol, folder: Path, settings: ProtocolSettings) -> tuple[Reader | None, str, str]:
    """The first of the protocol's splits that the folder has, its name; or why there is none."""
    if not folder.is_dir():
        return None, "", f"{folder}: no such folder"
    reasons: list[str] = []
    for split in protocol.splits:
        try:
            return _opened(protocol, folder, split, settings), split, ""
        except (InputError, OSError, ImportError) as error:
            reasons.append(f"{protocol.dataset}, split {split}: {error}")
    return None, "", "; ".join(reasons)


def _opened(protocol: Protocol, folder: Path | None, split: str, settings: ProtocolSettings) -> Reader:
    return open_evaluation_set(
        protocol.dataset,
        folder,
        split=split,
        image_size=PrincipalPointCrop(settings.longer_edge).size((3, 4)),
        options=settings.options.get(protocol.dataset, {}),
    )
