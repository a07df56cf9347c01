#!/usr/bin/env bash
# Trains on this machine: one learner and N actors, progress on the terminal, an evaluation table at the end.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/run_local.sh [--actors N] [--config FILE] [--run-dir DIR] [--set section.key=value ...]
       launch/run_local.sh --resume DIR [--actors N]

Builds Skein, starts one learner and N actors on this machine, shows their progress, and ends with an evaluation of the best
snapshot and the paths of everything the run leaves behind.

Options:
  --actors N               actors to start [default: number of cores]
  --config FILE            what to train and how [default: configs/local.toml]; see configs/ for others
  --run-dir DIR            where everything goes; must be new or empty [default: runs/<date>_<time>]
  --set section.key=value  change one setting of the config, for example --set run.seed=7; may be repeated;
                           paths are relative to the working directory, in FILE they are relative to FILE
  --resume DIR             go on with the run in DIR, which was stopped, failed or was cut off, from its newest checkpoint: with
                           its own configuration, and as many actors as you like; it comes to the same as if nothing had happened
  -h, --help               this text

Ctrl-C stops in order: episodes in the air are abandoned, the updates of the epoch are finished, everything learned is saved. A
second Ctrl-C stops at once.
RUST_LOG=debug makes the logs in DIR/logs say more; SKEIN_LOG_FORMAT=json writes them as one JSON object a line.

Exit status: 0 finished, 1 failed, 2 called wrongly, 130 interrupted.
END

build
for argument in "$@"; do
    if [[ $argument == --resume || $argument == --resume=* ]]; then
        run_built skein run "$@"
    fi
done
run_built skein run --config "$repository/configs/local.toml" \
    --run-dir "$repository/runs/$(date +%Y-%m-%d_%H-%M-%S)" "$@"
