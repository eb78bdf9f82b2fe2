"""Which clip of which data set is example i of a run, and which examples have the same size."""

import hashlib
import sys
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grain
import numpy as np
from absl import logging

from logvggt_jax.data.dataset import ConfidentDataset, Dataset
from logvggt_jax.data.feeding.augmentation import ColourAugmentation
from logvggt_jax.data.feeding.broken_clips import describe
from logvggt_jax.data.feeding.clips import ClipReader, ReplaceBroken, Size
from logvggt_jax.data.feeding.frame_range import longest
from logvggt_jax.data.feeding.listed_frames import listed_frames
from logvggt_jax.data.feeding.sampling import Sampler
from logvggt_jax.data.feeding.transforms import nearest_size
from logvggt_jax.errors import InputError

FRAMES = "frames"  # in what examples are drawn from: `ListedFrames`
TEACHERS = "teachers"  # likewise, where there are any: digests of what labelled the data sets, by name
SHAPES = "shapes"  # likewise, where clips have several sizes: `Shapes`
Shapes = Mapping[str, Mapping[str, str]]
"""By data set and sequence the size of its clips, such as `392x518`. JSON types."""
_SIZE_READERS = 16


def mixture(
    datasets: Mapping[str, Dataset],
    samplers: Mapping[str, Sampler],
    shares: Mapping[str, float],
    sizes: Sequence[Size],
    *,
    batch_size: int,
    seed: int,
    augmentation: ColourAugmentation | None,
    min_valid_depth: float,
    replace_broken: bool,
    shapes: Shapes,
) -> tuple[grain.MapDataset, dict[str, Any], list[Size]]:
    """The endless examples of `training_batches`, JSON values that say what they are drawn from, and the sizes that
    occur among them.

    Examples are clips by index, `batch_size` in a row of one size; with `replace_broken` none of them fails, see
    `clips.ReplaceBroken`. Sequences that are in `shapes` keep the size that they had, whatever their pictures say now.
    """
    sequences = {
        name: _by_size(
            name,
            dataset,
            _long_enough(name, dataset, samplers[name], skip_broken=replace_broken),
            sizes,
            shapes.get(name, {}),
            skip_broken=replace_broken,
        )
        for name, dataset in datasets.items()
    }

    # Each data set and size draws from its own stream, so that equal numbers do not mean equal choices.
    own_seeds, names = {}, {}
    for position, name in enumerate(datasets):
        for size_index, part in enumerate(sequences[name]):
            if part:
                own_seed = int(np.random.SeedSequence([seed, position, size_index]).generate_state(1)[0])
                own_seeds[name, size_index] = own_seed
                names[name, size_index] = grain.MapDataset.source(_Epochs(part, own_seed))

    def clips(name: str, size_index: int) -> grain.MapDataset:
        def stream(name: str, part: int) -> tuple[ClipReader, grain.MapDataset]:
            own_seed = own_seeds[name, part]
            return (
                ClipReader(
                    name, datasets[name], samplers[name], sizes[size_index], own_seed, augmentation, min_valid_depth
                ),
                names[name, part],
            )

        read, own = stream(name, size_index)
        if not replace_broken:
            return own.map_with_index(read)
        # Where all of its own is broken: of the same set in other shapes, cut to this one, then of the other sets.
        order = sorted(names, key=lambda key: (key != (name, size_index), key[0] != name))
        return own.map_with_index(ReplaceBroken([stream(*key) for key in order]))

    examples: list[grain.MapDataset] = []
    size_shares: list[float] = []
    occurring: list[Size] = []
    for size_index in range(len(sizes)):
        parts, part_shares = [], []
        for name in datasets:
            if count := len(sequences[name][size_index]):
                parts.append(clips(name, size_index))
                part_shares.append(shares[name] * count / sum(map(len, sequences[name])))
        if parts:
            examples.append(parts[0] if len(parts) == 1 else grain.MapDataset.mix(parts, weights=part_shares))
            size_shares.append(sum(part_shares))
            occurring.append(sizes[size_index])
    identity = {
        "seed": seed,
        # Who changes how an epoch is ordered changes this: a state of before would go on with other clips.
        "order": "permutations",
        "samplers": {name: repr(sampler) for name, sampler in samplers.items()},
        "sizes": [list(size) for size in sizes],
        FRAMES: listed_frames(datasets),
        "sequences": {name: [_fingerprint(part) for part in parts] for name, parts in sequences.items()},
        "weights": dict(shares),
        "augmentation": repr(augmentation),
        "min_valid_depth": float(min_valid_depth),
    }
    if teachers := {name: each.labelled_by for name, each in datasets.items() if isinstance(each, ConfidentDataset)}:
        identity[TEACHERS] = teachers
    if len(sizes) > 1:
        identity[SHAPES] = {
            name: {sequence: _written(size) for size, part in zip(sizes, parts, strict=True) for sequence in part}
            for name, parts in sequences.items()
        }
    if len(examples) > 1:
        turns = [grain.MapDataset.source([size]).repeat().map_with_index(_Turn()) for size in range(len(examples))]
        schedule = grain.MapDataset.mix(turns, weights=size_shares)
        examples = [grain.MapDataset.source(_OneSizeABatch(examples, schedule, batch_size))]
        identity["batch_size"] = batch_size
    return examples[0], identity, occurring


class _Epochs:
    """Sequences without end: each pass visits every one of them once, in an order of its own.

    Grain's own shuffling seeks each index among 65,536, which takes 7 ms for three sequences.
    """

    def __init__(self, sequences: Sequence[str], seed: int) -> None:
        self.sequences, self.seed = sequences, seed
        self._orders: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return sys.maxsize

    def __getitem__(self, index: int) -> str:
        epoch, place = divmod(index, len(self.sequences))
        order = self._orders.get(epoch)
        if order is None:
            order = np.random.default_rng([self.seed, epoch]).permutation(len(self.sequences))
            # Threads that read ahead are at most in the next epoch.
            self._orders = {epoch: order, **{e: o for e, o in self._orders.items() if abs(e - epoch) == 1}}
        return self.sequences[order[place]]


class _OneSizeABatch:
    """Examples of several sizes in such an order that each run of `batch_size` has one size.

    Batch b holds the next examples of size `turns[b]` = (size, how many batches of that size came before).
    """

    def __init__(self, examples: Sequence[grain.MapDataset], turns: grain.MapDataset, batch_size: int) -> None:
        self.examples, self.turns, self.batch_size = examples, turns, batch_size

    def __len__(self) -> int:
        return sys.maxsize

    def __getitem__(self, index: int) -> dict[str, Any]:
        batch, place = divmod(index, self.batch_size)
        size, before = self.turns[batch]
        return self.examples[size][before * self.batch_size + place]


class _Turn:
    """(size, number of its batch), for Grain's mixing of sizes."""

    def __call__(self, index: int, size: int) -> tuple[int, int]:
        return size, index


def _long_enough(name: str, dataset: Dataset, sampler: Sampler, *, skip_broken: bool) -> list[str]:
    """The sequences that hold a clip; InputError if there are none.

    With `skip_broken` a sequence that cannot be listed stays: its clips are then broken and counted, and the examples
    are the same ones when it has been mended.
    """

    def fits(sequence: str) -> bool:
        try:
            return sampler.fits(dataset, sequence)
        except Exception as error:
            if not skip_broken:
                raise
            logging.warning("%s, %s: cannot be listed: %s", name, sequence, describe(error))
            return True

    names = [sequence for sequence in dataset.sequences if fits(sequence)]
    if not names:
        raise InputError(
            f"{name}: none of {len(dataset.sequences)} sequences has {sampler.requirement}; {longest(dataset)}: "
            "shorten the clips, or take more frames"
        )
    if len(names) < len(dataset.sequences):
        short = len(dataset.sequences) - len(names)
        logging.warning("%s: %d sequences do not have %s, left out", name, short, sampler.requirement)
    return names


def _by_size(
    name: str,
    dataset: Dataset,
    sequences: Sequence[str],
    sizes: Sequence[Size],
    known: Mapping[str, str],
    *,
    skip_broken: bool,
) -> list[list[str]]:
    """For each of `sizes` the sequences whose pictures have the nearest aspect ratio, or had it when it became `known`.

    With `skip_broken` those whose pictures cannot be read have the first size, where their clips will be broken.
    """
    if len(sizes) == 1:
        return [list(sequences)]

    reasons: list[str] = []
    by_name = {_written(size): size for size in sizes}

    def size_of(sequence: str) -> Size | None:
        # One whose pictures could not be read then, or cannot be now, would make other batches.
        if (size := by_name.get(known.get(sequence, ""))) is not None:
            return size
        try:
            return nearest_size(dataset.image_size(sequence), sizes)
        except Exception as error:
            if not skip_broken:
                raise
            reasons.append(describe(error))
            logging.warning("%s, %s: size of the pictures unknown: %s", name, sequence, reasons[-1])
            return None

    parts: dict[Size, list[str]] = {size: [] for size in sizes}
    # The first start opens a picture of every sequence, which takes long over a network; readers keep the sizes.
    with ThreadPoolExecutor(_SIZE_READERS) as executor:
        found = list(executor.map(size_of, sequences))
    for sequence, size in zip(sequences, found, strict=True):
        parts[sizes[0] if size is None else size].append(sequence)
    if not any(found):
        first = f", the first because {reasons[0]}" if reasons else ""
        raise InputError(f"{name}: no picture of {len(sequences)} sequences can be read{first}; the log names all")
    return list(parts.values())


def _written(size: Size) -> str:
    return f"{size[0]}x{size[1]}"


def _fingerprint(sequences: Sequence[str]) -> str:
    """Number and digest of sequence names: other sequences would make other examples."""
    return f"{len(sequences)} {hashlib.sha256(chr(10).join(sequences).encode()).hexdigest()[:12]}"
