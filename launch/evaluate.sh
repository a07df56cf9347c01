#!/usr/bin/env bash
# Flies a snapshot through courses without exploration, and prints how far it got.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein-evaluate -- "$@" <<END
launch/evaluate.sh OPTIONS builds what flying needs and runs "skein-evaluate" with these options.
END

build_evaluation
run_built skein-evaluate "$@"
