#!/usr/bin/env bash
# Adds actors to a run that is under way on this machine.
set -euo pipefail
# shellcheck source=common.sh
source "$(dirname "$(readlink -f "${BASH_SOURCE[0]}")")/common.sh"

help_if_asked skein attach -- "$@" <<END
launch/attach_actor.sh OPTIONS builds Skein and runs "skein attach" with these options.
END

build_training
run_built skein attach "$@"
