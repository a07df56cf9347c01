#!/usr/bin/env bash
# Trains once in peace and once under fire, and shows that it makes no difference.
set -euo pipefail
# shellcheck source=../launch/common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../launch/common.sh"

help_if_asked skein-chaos -- "$@" <<END
tests/chaos.sh [OPTIONS] builds Skein and runs "skein-chaos" with these options. By default it trains
configs/smoke.toml in runs/chaos_<date>_<time>_<process>.
END

# --calm brings its own configuration.
config=(--config "$repository/configs/smoke.toml")
for argument in "$@"; do
    if [[ $argument == --calm || $argument == --calm=* ]]; then
        config=()
    fi
done

build
run_built skein-chaos "${config[@]}" --run-dir "$repository/runs/chaos_$(date +%Y-%m-%d_%H-%M-%S)_$$" "$@"
