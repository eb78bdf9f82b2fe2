#!/usr/bin/env bash
# Goes on training from the model that ships as `rooms`, with clips of 12 and of 32 frames in turn.
#
#     scripts/train_small.sh                                # until all steps are done
#     scripts/train_small.sh --config.max_minutes=8         # in pieces of eight minutes
#
# The same command goes on with the run. scripts/ship_model.py puts its model into the package.
set -euo pipefail
cd "$(dirname "$0")/.."
exec "${PYTHON:-python}" train.py --config=configs/rooms.py:rooms --workdir=runs/rooms-more "$@"
