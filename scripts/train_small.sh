#!/usr/bin/env bash
# Goes on training from the model that ships as `rooms`, with clips of the last stage of configs/small.py.
#
#     scripts/train_small.sh                                                       # one GPU, a piece of eight minutes
#     scripts/train_small.sh --config.model.dtype=float32 --config.max_minutes=120       # a CPU
#
# The same command goes on with the run. scripts/ship_model.py puts its model into the package.
set -euo pipefail
cd "$(dirname "$0")/.."
exec "${PYTHON:-python}" train.py --config=configs/small.py:rooms --workdir=runs/small-more "$@"
