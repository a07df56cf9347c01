#!/usr/bin/env bash
# Simulates learner and actors in storms of mishaps, one for each seed.
set -euo pipefail
# shellcheck source=../launch/common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/../launch/common.sh"

help_if_asked skein-storm -- "$@" <<END
tests/storm.sh [OPTIONS] builds Skein and runs "skein-storm" with these options.
END

build
run_built skein-storm "$@"
