"""Which frames a run's clips are drawn from: a sequence that has others when the run goes on gives other clips."""

from collections.abc import Iterator, Mapping

from logvggt_jax.data.dataset import Dataset
from logvggt_jax.data.feeding.frame_range import frames_of
from logvggt_jax.errors import InputError

ListedFrames = Mapping[str, Mapping[str, str | None]]
"""By data set and sequence the frames that it gives, such as `0:800`; None where it cannot be listed. JSON types."""

_NAMED = 5


def listed_frames(datasets: Mapping[str, Dataset]) -> dict[str, dict[str, str | None]]:
    """What `datasets` list now, sequences too short for a clip as well: they may grow."""
    return {
        name: {sequence: _listed(dataset, sequence) for sequence in dataset.sequences}
        for name, dataset in datasets.items()
    }


def check_listed_frames(then: ListedFrames, now: ListedFrames) -> None:
    """Raises InputError naming the sequences, of the data sets in both, whose frames are not those of `then`.

    One that could not be listed, then or now, is passed over: its clips are broken, and those of the others the same.
    """
    found = [line for name in then if name in now for line in _changes(name, then[name], now[name])]
    if found:
        more = f"; and {len(found) - _NAMED} more" if len(found) > _NAMED else ""
        raise InputError(
            f"sequences have changed since the checkpoint was written: {'; '.join(found[:_NAMED])}{more}. The clips "
            "would be others, and frames that were kept for validation may be among them: give the sequences back the "
            "frames that they had (a copy of them may lie in another folder), or start a new --workdir, which "
            "--config.initial_weights lets begin with the model of this one"
        )


def _listed(dataset: Dataset, sequence: str) -> str | None:
    try:
        frames = frames_of(dataset, sequence)
    except Exception:  # of whatever kind a damaged listing raises; who asks for clips has named it
        return None
    return f"{frames.start}:{frames.stop}"


def _changes(name: str, then: Mapping[str, str | None], now: Mapping[str, str | None]) -> Iterator[str]:
    for sequence in dict.fromkeys((*then, *now)):
        where = f"{name}, {sequence}"
        if sequence not in now:
            yield f"{where} is gone"
        elif sequence not in then:
            yield f"{where} is new"
        elif then[sequence] != now[sequence] and None not in (then[sequence], now[sequence]):
            yield f"{where} had frames {then[sequence]} and has {now[sequence]} now"
