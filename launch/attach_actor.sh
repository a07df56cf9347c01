#!/usr/bin/env bash
# Adds actors to a run that is under way on this machine.
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"

help_if_asked "$@" <<END
Usage: launch/attach_actor.sh --run DIR [--count N]

Starts N more actors for a run that is under way, and stays with them until the run ends; when its learner is started again, they
find it by themselves. They change how fast the run gets on, never what it learns. Ctrl-C takes them away again.

Options:
  --run DIR    the run's directory, as launch/run_local.sh printed it
  --count N    actors to start [default: 1]
  -h, --help   this text

Exit status: 0 the run ended, 1 failed, 130 interrupted.
END

build
run_built skein attach "$@"
