#!/usr/bin/env bash
# Trains on this machine: one learner and N actors, progress on the terminal, an evaluation table at the end.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein run -- "$@" <<END
launch/run_local.sh [OPTIONS] builds Skein and runs "skein run" with these options. By default it
trains configs/local.toml in runs/<date>_<time>_<process>.
END

build_training
# The process id tells apart two starts in one second.
for argument in "$@"; do
    if [[ $argument == --resume || $argument == --resume=* ]]; then
        run_built skein run "$@"
    fi
done
run_built skein run --config "$repository/configs/local.toml" \
    --run-dir "$repository/runs/$(date +%Y-%m-%d_%H-%M-%S)_$$" "$@"
