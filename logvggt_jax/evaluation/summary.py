"""From clips to tables: means over the clips of a benchmark, their spread, and what could not be measured."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from logvggt_jax.evaluation.methods.method import Method
from logvggt_jax.evaluation.plan import Benchmark, Clip
from logvggt_jax.evaluation.records import ClipRecords
from logvggt_jax.evaluation.scores import ClipScore, benchmark_score


def summarize(
    benchmarks: Sequence[Benchmark],
    methods: Sequence[Method],
    plan: Sequence[Clip],
    skipped: Sequence[Mapping[str, Any]],
    records: ClipRecords,
    keys: Mapping[tuple[Clip, str], str],
) -> dict[str, Any]:
    """`benchmarks`, `summary`, `failures` and `figures` of results.json, from the records of this run's clips."""
    summary: list[dict[str, Any]] = []
    failures: list[dict[str, Any]] = []
    described: list[dict[str, Any]] = []
    figures: list[str] = []
    for benchmark in benchmarks:
        protocol = benchmark.protocol
        clips = [clip for clip in plan if clip.benchmark is benchmark]
        left_out = {entry["sequence"] for entry in skipped if entry["benchmark"] == protocol.name}
        planned = len(clips) + len(left_out - {clip.sequence for clip in clips})
        lengths = sorted({len(clip.indices) for clip in clips})
        described.append(
            {
                "name": protocol.name,
                "title": protocol.title,
                "dataset": protocol.dataset,
                "split": benchmark.split,
                "missing": benchmark.missing,
                "sequences": len(benchmark.sequences),
                "expected": protocol.expected,
                "planned": planned,
                "frames": protocol.frames.describe(),
                "images": protocol.images.describe(),
                "wanted": protocol.frames.wanted,
                "frames_used": [lengths[0], lengths[-1]] if lengths else None,
                "decisions": list(protocol.decisions),
                "settings": protocol.describe(),
            }
        )
        for method in methods:
            asked = [keys[clip, method.name] for clip in clips if (clip, method.name) in keys]
            done = [records[key] for key in asked if key in records]
            scores = [(each["sequence"], ClipScore(each["metrics"], each["failures"])) for each in done]
            if done:
                score = benchmark_score(protocol, method, scores, planned)
                spread = {"spread": _spread(benchmark, method, scores)} if protocol.sets > 1 else {}
                asked_of = {"benchmark": protocol.name, "frames": protocol.frames.wanted, "method": method.name}
                summary.append({**asked_of, **score, **spread})
            for record in done:
                where = {key: record[key] for key in ("benchmark", "sequence", "frames", "method")}
                failures += [{**where, "metric": group, "reason": why} for group, why in record["failures"].items()]
                figures += record["figures"] or []
    return {"benchmarks": described, "summary": summary, "failures": failures, "figures": figures}


def _spread(benchmark: Benchmark, method: Method, scores: Sequence[tuple[str, ClipScore]]) -> dict[str, float]:
    """Standard deviation over the protocol's sets of sequences, of each mean that two sets or more have."""
    number = {name: position % benchmark.protocol.sets for position, name in enumerate(benchmark.sequences)}
    sets = [[each for each in scores if number[each[0]] == chosen] for chosen in range(benchmark.protocol.sets)]
    means = [benchmark_score(benchmark.protocol, method, part, len(part)) for part in sets if part]
    keys = dict.fromkeys(key for mean in means for key in mean)
    values = {key: [mean[key] for mean in means if key in mean] for key in keys}
    return {key: float(np.std(found, ddof=1)) for key, found in values.items() if len(found) > 1}
