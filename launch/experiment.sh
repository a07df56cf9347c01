#!/usr/bin/env bash
# Runs one of the experiments of configs/experiments/ with several seeds, and reports what it found.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein experiment -- "$@" <<END
launch/experiment.sh NAME [OPTIONS] builds Skein and runs "skein experiment" with these options.
END

build_training
run_built skein experiment --repository "$repository" "$@"
